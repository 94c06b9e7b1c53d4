"""Arms of ours as an embodiment of Inspect Robots, found there as ``vla_zenoh``."""
