"""Encoding and decoding, ours and ROS 2's."""
