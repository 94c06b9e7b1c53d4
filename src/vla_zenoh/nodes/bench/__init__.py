"""What `vla-zenoh bench` measures with: nodes, robots and chains of its own."""
