"""Section 4.3 and beyond: what HRL-DCS is compared with."""
