"""Our response of a controller beside robosuite's own controller."""
