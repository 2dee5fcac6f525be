"""Questions about a map, and the one way from request to reply."""
