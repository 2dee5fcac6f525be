"""The scans that a map was learnt from, in MCAP files that ROS 2 and its tools play."""
