"""The robot node, and its drivers: the simulator, ROS 2, and a Python file."""
