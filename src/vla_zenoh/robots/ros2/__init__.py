"""Driver of ROS 2 robots."""
