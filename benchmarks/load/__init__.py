"""Robots and cameras that one router carries."""
