"""Clouds, depth images and poses, from messages of ROS 2 to scans."""
