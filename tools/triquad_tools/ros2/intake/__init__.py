"""From messages of ROS 2 to published scans: clouds, depth images and poses."""
