"""What a program needs to drive a robot: its client, and what it can ask the robot to do."""
