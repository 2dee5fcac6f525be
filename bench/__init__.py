"""Benchmarks, campaigns and studies: they measure triquad, and are not installed."""
