"""The map as messages of ROS 2: markers and occupancy grids."""
