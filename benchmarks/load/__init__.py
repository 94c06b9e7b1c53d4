"""Number of robots and cameras that one router carries."""
