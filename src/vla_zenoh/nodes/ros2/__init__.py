"""The node that drives a ROS 2 robot: see `vla_zenoh.nodes.ros2.node`."""
