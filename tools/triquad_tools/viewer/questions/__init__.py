"""Questions to a map: slices, unknown space, points, paths, and what changed."""
