"""Meshes: tiles joined, followed and saved."""
