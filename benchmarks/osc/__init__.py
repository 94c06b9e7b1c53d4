"""Our response of a controller compared with robosuite's own controller."""
