"""Vision-language-action models and robots, joined by Zenoh."""

__version__ = "0.1.0"
