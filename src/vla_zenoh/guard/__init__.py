"""The robot's side of a command stream: who is followed, and how fast. Pure."""
