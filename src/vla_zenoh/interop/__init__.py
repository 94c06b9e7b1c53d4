"""Protocols of other systems, without I/O: policy servers and ROS 2."""
