"""From what robots and sensors say to points with a pose: numpy, and rosbags for ROS."""
