"""Training: what regions still have to learn, where, and at which rates."""
