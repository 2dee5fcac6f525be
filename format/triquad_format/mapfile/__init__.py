"""The map file: writing, reading, and reading parts of it."""
