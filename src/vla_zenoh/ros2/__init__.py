"""ROS 2 without ROS: the messages of its distributions, with their type hashes and CDR."""
