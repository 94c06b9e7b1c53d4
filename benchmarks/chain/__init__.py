"""A picture's way to a pose command, beside other ways of serving a model."""
