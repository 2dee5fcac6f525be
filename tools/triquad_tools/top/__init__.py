"""How a map server is doing, as it goes: a page for people, and the same figures for programs."""
