"""Readers of recorded scans."""
