"""The benchmarks: each part checks a promise of the README."""
