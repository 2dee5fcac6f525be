"""The live state of a map server: a page for people, and the same figures for programs."""
