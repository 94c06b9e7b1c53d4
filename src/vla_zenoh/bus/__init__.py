"""Zenoh sessions, publishers, subscribers and clocks: what every node of the package shares."""
