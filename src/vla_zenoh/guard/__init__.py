"""The robot's side of a command stream: which writer is followed, and how fast. Pure."""
