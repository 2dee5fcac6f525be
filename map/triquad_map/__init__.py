"""A map in memory, and what can be asked of it."""
