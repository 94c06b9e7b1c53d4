"""Trials of models without a person: a program resets the scene and judges every episode."""
