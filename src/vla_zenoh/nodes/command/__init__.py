"""The command node: action chunks in, a bounded, jerk-limited command stream out."""
