"""Where things stand in a Rerun recording, and in which colours."""

from __future__ import annotations

import rerun as rr

TIMELINE = "time"
WORLD = "world"
ROBOT = "world/robot"
POSES = "world/pose"
TRAILS = "world/trail"
CHUNKS = "world/chunk"
OBJECTS = "world/objects"
CAMERA, SEEN = "camera", "seen"
LATENCY, SPEED, TRACKING = "plot/latency", "plot/speed", "plot/tracking"
GRIPPER, BOUNDS, JOINTS = "plot/gripper", "plot/bounds", "plot/joints"
NOW, EVENTS, PROFILE = "text/now", "events", "text/profile"

GOAL, COMMANDED, MEASURED = "goal", "commanded", "measured"
COLOURS = {GOAL: (86, 205, 124), COMMANDED: (255, 176, 58), MEASURED: (94, 166, 255)}
CHUNK, SHADOW = (236, 92, 206), (150, 110, 160)
"""Chunks of the obeyed worker, and of the others."""


def below(path: str, name: str) -> str:
    """`path` and a name of anybody's choice below it."""
    return f"{path}/{rr.escape_entity_path_part(name)}"


def picture(camera: str) -> str:
    """What a camera sees."""
    return below(CAMERA, camera)


def seen(worker: str, camera: str) -> str:
    """What a worker's model was given of a camera."""
    return below(below(SEEN, worker), camera)


def said(worker: str) -> str:
    """What a worker's model answered, in words."""
    return f"{below(SEEN, worker)}/answer"
