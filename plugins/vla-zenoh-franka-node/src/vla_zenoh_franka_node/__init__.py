"""Franka arms behind franka-node, for vla-zenoh."""
