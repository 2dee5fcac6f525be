"""The client of triquad map servers."""
