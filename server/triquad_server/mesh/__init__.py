"""Mesh tiles: meshing, cache and change feed."""
