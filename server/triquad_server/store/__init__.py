"""Checkpoints on disk: written, retained, locked and restored."""
