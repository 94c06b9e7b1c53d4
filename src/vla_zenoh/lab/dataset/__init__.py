"""Recorded runs as data to train on."""
