"""Topics of ROS 2 over Zenoh: clouds and poses in, the map out."""
