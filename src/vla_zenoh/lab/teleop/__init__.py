"""Teleoperation: a worker whose policy is the operator at the keyboard, gamepad or SpaceMouse."""
