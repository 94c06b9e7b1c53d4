"""Entity paths and colours of a Rerun recording."""

from __future__ import annotations

import rerun as rr

TIMELINE = "time"
WORLD = "world"
ROBOT, POSES, TRAILS, CHUNKS = "robot", "pose", "trail", "chunk"
"""Of an arm, below `arm`."""
OBJECTS = "world/objects"
CAMERA, SEEN = "camera", "seen"
LATENCY, SPEED, TRACKING = "plot/latency", "plot/speed", "plot/tracking"
GRIPPER, BOUNDS, JOINTS = "plot/gripper", "plot/bounds", "plot/joints"
NOW, EVENTS, PROFILE = "text/now", "events", "text/profile"

GOAL, COMMANDED, MEASURED = "goal", "commanded", "measured"
COLOURS = {GOAL: (86, 205, 124), COMMANDED: (255, 176, 58), MEASURED: (94, 166, 255)}
CHUNK, SHADOW = (236, 92, 206), (150, 110, 160)
"""Colours of chunks of the obeyed worker, and of workers in the shadow."""


def below(path: str, name: str) -> str:
    """The path of any name below `path`."""
    return f"{path}/{rr.escape_entity_path_part(name)}"


def arm(part: str) -> str:
    """The base frame of a part of the robot; of no part: of a robot that is one arm."""
    return below(WORLD, part) if part else WORLD


def plot(origin: str, part: str) -> str:
    """The time series of a part, below those of the robot."""
    return below(origin, part) if part else origin


def picture(camera: str) -> str:
    return below(CAMERA, camera)


def seen(worker: str, camera: str) -> str:
    """Input images of a worker's model from a camera."""
    return below(below(SEEN, worker), camera)


def answer(worker: str) -> str:
    """Answers of a worker's model, as text."""
    return f"{below(SEEN, worker)}/answer"
