"""Replicas of a model by Ray Serve, behind one worker: the model ``ray_serve``."""
