"""Fixed motions by prompt: what the scripted models do, and what a demo compares."""
