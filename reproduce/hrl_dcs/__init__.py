"""Section 3: the paper's method. SGN sets sub-goals, LLN follows them."""
