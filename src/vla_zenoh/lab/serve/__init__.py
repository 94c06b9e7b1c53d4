"""Serves our models to the clients of other policy servers."""
