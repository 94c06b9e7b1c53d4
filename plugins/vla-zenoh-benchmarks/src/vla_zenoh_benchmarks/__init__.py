"""Manipulation benchmarks of others as robots: a contract, episodes over the keys, results."""
