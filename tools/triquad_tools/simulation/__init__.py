"""Exact scenes and simulated sensors."""
