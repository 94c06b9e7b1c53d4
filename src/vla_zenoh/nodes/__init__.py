"""Processes on the bus. The only rooms that know Zenoh, clocks and threads."""
