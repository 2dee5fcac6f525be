"""Published, immutable states of the map."""
