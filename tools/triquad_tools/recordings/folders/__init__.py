"""Readers of folders that hold a file for each scan, and a trajectory."""
