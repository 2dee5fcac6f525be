"""Layers by which people ask the map: slices, unknown space, points and paths."""
