"""The worker node: observations in, action chunks out."""
