"""The two-layer method: networks, sub-goals, hierarchy."""
