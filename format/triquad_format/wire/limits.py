"""Limits of requests that clients check before they send, and servers before they answer."""

MIN_LENGTH_M = 1e-6
"""Of distances, ranges and grid cells: what is smaller is a mistake."""

MAX_DISTANCE_M = 100.0
"""How far around a point surfaces may be looked for; also the largest radius and grid cell."""

MAX_RANGE_M = 1_000.0
"""Of rays; also the longest segment."""

MAX_ITERATIONS = 200
"""Steps of an alignment."""
