"""Robot nodes: the simulator, ROS 2, and arms driven by a Python file."""
