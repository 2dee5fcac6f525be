"""The benchmarks: each part guards a promise of the README."""
