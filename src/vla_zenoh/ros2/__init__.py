"""ROS 2 without ROS: messages, type hashes, names and keys of both transports."""
