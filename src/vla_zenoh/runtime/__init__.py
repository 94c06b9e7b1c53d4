"""Processes of a host: starting, supervising, scheduling and stopping nodes; the Zenoh router."""
