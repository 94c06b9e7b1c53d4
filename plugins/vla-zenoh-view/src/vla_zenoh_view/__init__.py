"""Live and recorded runs in Rerun."""
