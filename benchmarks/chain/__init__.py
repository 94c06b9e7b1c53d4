"""From a camera image to a pose command, compared with other ways of serving a model."""
