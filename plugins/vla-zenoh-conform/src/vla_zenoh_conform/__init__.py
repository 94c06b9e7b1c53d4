"""Judges a live peer of others by the rules of the wire."""
