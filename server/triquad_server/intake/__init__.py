"""Scans, from the wire to rays."""
