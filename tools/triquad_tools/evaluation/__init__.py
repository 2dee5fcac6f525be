"""Scores of maps and meshes."""
