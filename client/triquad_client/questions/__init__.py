"""Calls that ask about the map."""
