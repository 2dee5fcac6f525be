"""Maps that answer without a server."""
