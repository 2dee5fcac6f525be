"""Turning data of robots and sensors into points with a pose: numpy, and rosbags for ROS."""
