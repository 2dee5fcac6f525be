"""The demonstration, on a street with a known answer."""
