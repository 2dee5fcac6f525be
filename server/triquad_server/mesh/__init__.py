"""Mesh tiles: which there are, those that are kept, and the feed of what changed."""
