"""Check of a model against its contract, without a robot."""
