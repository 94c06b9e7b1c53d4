"""Evaluation of recorded runs."""
