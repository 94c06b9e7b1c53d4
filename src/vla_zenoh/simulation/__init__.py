"""The simulated robot, its scene and its cameras: no Zenoh, no clock, no thread."""
