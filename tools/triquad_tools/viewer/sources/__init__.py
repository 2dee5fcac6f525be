"""Where a page takes its map from: a server, a file, or the checkpoints of a store."""
