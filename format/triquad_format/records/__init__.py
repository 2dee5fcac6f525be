"""A map as plain arrays."""
