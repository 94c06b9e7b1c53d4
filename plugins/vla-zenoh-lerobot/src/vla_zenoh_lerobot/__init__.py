"""Robot classes of LeRobot, run in an environment of their own."""
