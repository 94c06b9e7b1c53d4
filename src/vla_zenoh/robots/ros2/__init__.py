"""Driver of robots that speak ROS 2."""
