"""Node that runs a model: observations in, action chunks out."""
