"""A model that looks at colour and depth, and its worker at work."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from camera_rig import Rig, until

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy import (
    ActionSpec,
    CameraSpec,
    DepthSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.types import Header, Task


class Looker:
    """A model of colour and depth that keeps what it was given."""

    def __init__(self, takes_s: float = 0.0, camera: str = "front", **fields: Any) -> None:
        self._takes_s = takes_s
        looks = ObservationSpec(
            cameras=(CameraSpec(camera=camera),),
            depth=(DepthSpec(camera=camera, unit_m=0.0005, far_m=3.0),),
            state=(),
            prompt=False,
            max_age_s=5.0,
            **fields,
        )
        action = ActionSpec(horizon=1, dt_s=0.1, gripper="none")
        self.spec = ModelSpec(name="looker", observation=looks, action=action)
        self.seen: list[Observation] = []

    def infer(self, observation: Observation) -> list[list[float]]:
        self.seen.append(observation)
        time.sleep(self._takes_s)
        return [[0.0] * 6]


@contextmanager
def looking(rig: Rig, model: Looker) -> Iterator[Callable[[], None]]:
    """The model's worker at work; what is yielded tells it its task."""
    number = itertools.count()
    with open_session(rig.profile.session) as session:
        worker = WorkerNode(rig.profile, session, model, "looker")
        stop = threading.Event()
        thread = threading.Thread(target=worker.run, args=(stop,))
        thread.start()
        tasks = rig.watcher.declare_publisher(rig.profile.keys.task)

        def tell() -> None:
            task = records.encode(Task(1, False, "", "looker", 10.0))
            header = Header(time.time_ns(), next(number), "command#test")
            tasks.put(task, attachment=records.encode_header(header))

        try:
            until("a worker", lambda: tasks.matching_status.matching)
            yield tell
        finally:
            stop.set()
            thread.join()
