"""Requests: their order, their workers, and their results."""
