"""Sources of a page's map: a server, a file, or the checkpoints of a store."""
