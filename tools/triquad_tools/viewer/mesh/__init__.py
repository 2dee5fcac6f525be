"""The mesh in a scene: which tiles, how fine, in which colours."""
