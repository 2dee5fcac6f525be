"""What regions have still to learn, where, and at which rates."""
