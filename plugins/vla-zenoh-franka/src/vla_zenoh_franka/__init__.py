"""Franka arms over the Franka Control Interface (FCI), without ROS."""
