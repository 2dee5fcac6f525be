"""The calls of a client: each yields messages and is sent replies."""
