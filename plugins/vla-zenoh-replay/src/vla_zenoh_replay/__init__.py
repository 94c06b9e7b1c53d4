"""Publishes a recorded run again, on its keys or those of another robot."""
