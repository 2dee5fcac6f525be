"""Kernels of the evidence: what rays have shown."""
