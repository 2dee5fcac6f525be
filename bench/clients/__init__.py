"""Processes that the benchmarks need: servers, planners, noisy neighbours, a browser."""
