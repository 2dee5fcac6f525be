"""Surfels: what stands for the seen surface, and how well it is supported."""
