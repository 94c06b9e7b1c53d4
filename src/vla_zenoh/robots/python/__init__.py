"""An arm driven by a Python file."""
