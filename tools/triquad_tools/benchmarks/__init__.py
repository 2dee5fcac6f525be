"""How fast and how good it is on this machine."""
