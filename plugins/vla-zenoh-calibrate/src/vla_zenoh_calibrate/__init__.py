"""Calibrates a camera: its lens, and its place on a robot or beside one, with a ChArUco board."""
