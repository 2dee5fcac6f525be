"""Simulated places and sensors that only benchmarks and tests need."""
