"""Blind trials of models on a real arm, where a person judges every episode."""
