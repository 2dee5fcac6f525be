"""The triquad map server."""
