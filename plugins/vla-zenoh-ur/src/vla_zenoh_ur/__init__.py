"""UR arms over RTDE, without ROS."""
