"""The queries of clients: which operations there are, and their request handlers."""
