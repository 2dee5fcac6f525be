"""A bridge to ROS 2 over Zenoh, without ROS: clouds and poses go to a map server, the map back."""
