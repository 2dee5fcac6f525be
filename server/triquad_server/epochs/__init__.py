"""The published states of the map: what each answers, which are kept, and what changed."""
