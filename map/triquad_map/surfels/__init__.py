"""Kernels that search for the nearest surfel."""
