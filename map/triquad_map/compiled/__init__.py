"""A map answered by compiled code."""
