"""Where a lidar was, by its clouds alone: from scan to scan, and where it comes back to a place."""
