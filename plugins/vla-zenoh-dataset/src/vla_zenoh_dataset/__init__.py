"""Export of recorded runs as training data."""
