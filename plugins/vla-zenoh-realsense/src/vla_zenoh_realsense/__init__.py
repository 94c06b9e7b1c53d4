"""Intel RealSense cameras for vla-zenoh."""
