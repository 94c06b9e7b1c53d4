"""ROS 2 robots for vla-zenoh, without ROS: the node ros2, and the bridge that it speaks through."""
