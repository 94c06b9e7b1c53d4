"""Measures the chain and judges models by task."""
