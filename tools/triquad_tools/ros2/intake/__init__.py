"""Turning messages of ROS 2 into published scans: clouds, depth images and poses."""
