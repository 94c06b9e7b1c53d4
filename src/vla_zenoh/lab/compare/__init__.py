"""Comparison of the actions of two workers."""
