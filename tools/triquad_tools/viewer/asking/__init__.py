"""Layers for queries by people: slices, unknown space, points and paths."""
