"""Intel's physicalai on our bus: its robots as ours, and its clients as a worker of ours."""
