"""The base of all parts of a page: scene, panel, colours, and threads that refresh."""
