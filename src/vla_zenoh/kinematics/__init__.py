"""Rigid-body kinematics of an arm, and what bounds them. Pure: no Zenoh, no clock, no threads."""
