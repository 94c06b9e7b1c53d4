"""Nodes: processes on the bus, with Zenoh, clocks and threads."""
