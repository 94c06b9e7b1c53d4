"""Serves our models to the clients of openpi."""
