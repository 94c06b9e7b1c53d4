"""The node that drives a ROS 2 robot: see `vla_zenoh.robots.ros2.node`."""
