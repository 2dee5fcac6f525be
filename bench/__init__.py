"""Benchmarks, campaigns and studies: what measures triquad, and is not installed."""
