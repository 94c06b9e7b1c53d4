"""Recordings: MCAP files that Foxglove, Rerun and ``ros2 bag`` open, without loss."""
