"""A model worker in plain Python: puts a brick in the box.

    vla-zenoh up panda_bricks                       # in another terminal
    python examples/wire/worker.py [ENDPOINT] [ROBOT]
    vla-zenoh use plain && vla-zenoh prompt "put the red brick in the box" && vla-zenoh activate

Its model knows the simulator's true poses of the objects and follows waypoints.
"""

import hashlib
import json
import math
import sys
import threading
import time
from typing import Any

import msgpack
import zenoh
from plain_node import MSGPACK, MUST_ARRIVE, NEWS, Node, Rejected, open_session, read

WORKER = "plain"
STEP_S = 0.1
SPEC = {
    "name": WORKER,
    "observation": {
        "cameras": [],
        "state": ["pose", "gripper"],
        "prompt": True,
        "max_skew_s": 0.1,
        "max_age_s": 0.5,
    },
    # A step: x, y, z in m, roll, pitch, yaw in rad, and the opening of the gripper in m.
    "action": {
        "horizon": 1,
        "dt_s": STEP_S,
        "kind": "absolute",
        "frame": "base",
        "anchor": "goal",
        "relative_to": "previous",
        "controller": None,
        "rotation": "rpy",
        "position_scale_m": 1.0,
        "gripper": "absolute_m",
        "gripper_open_is_high": True,
        "gripper_threshold": 0.5,
        "normalisation": None,
        "pace": "steady",
        "space": "tcp",
        "joints": [],
    },
}
SPEC_HASH = hashlib.sha256(
    json.dumps(SPEC, sort_keys=True, separators=(",", ":")).encode()
).hexdigest()[:16]
VALID_NS = 1_000_000_000

# -- the model ------------------------------------------------------------------------------------
OPEN_M, SHUT_M = 0.08, 0.0
HOVER_M, CARRY_M, RELEASE_M = 0.10, 0.17, 0.09
GRIP_ABOVE_M = 0.004
NEAR_M, NEAR_RAD = 0.006, 0.1
DWELL_S = 0.7
"""At each waypoint, so that the gripper has opened or closed."""
STEP_M, STEP_RAD = 0.03, 0.15


def yaw_of(quaternion: list[float]) -> float:
    """Yaw in rad of x, y, z, w."""
    x, y, z, w = quaternion
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


class Model:
    """Goes from one waypoint to the next: x, y, z in m, yaw in rad, opening in m."""

    def __init__(self) -> None:
        self._waypoints: list[list[float]] = []
        self._since_s = 0.0

    def reset(self, prompt: str, yaw: float, objects: dict) -> None:
        """Plan a new episode; nothing, if the prompt names no brick."""
        self._waypoints, self._since_s = [], time.monotonic()
        name = next((f"{word}_brick" for word in prompt.split() if f"{word}_brick" in objects), "")
        if not name:
            return
        (x, y, z), quaternion = objects[name]
        (box_x, box_y, _), _ = objects["box"]
        # The brick may be held by either pair of its sides: turn to the nearer one.
        turn = (yaw_of(quaternion) - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
        yaw += turn
        self._waypoints = [
            [x, y, HOVER_M, yaw, OPEN_M],
            [x, y, z + GRIP_ABOVE_M, yaw, OPEN_M],
            [x, y, z + GRIP_ABOVE_M, yaw, SHUT_M],
            [x, y, CARRY_M, yaw, SHUT_M],
            [box_x, box_y, CARRY_M, yaw, SHUT_M],
            [box_x, box_y, RELEASE_M, yaw, SHUT_M],
            [box_x, box_y, RELEASE_M, yaw, OPEN_M],
            [box_x, box_y, CARRY_M, yaw, OPEN_M],
        ]

    def infer(self, pose: dict, gripper: dict) -> list[float]:
        """The next step: x, y, z, roll, pitch, yaw, opening."""
        tcp, yaw = pose["position_m"], yaw_of(pose["quat_xyzw"])
        if not self._waypoints:
            return [*tcp, math.pi, 0.0, yaw, max(gripper["width_m"], 0.0)]
        *goal, goal_yaw, width_m = self._waypoints[0]
        way = [there - here for there, here in zip(goal, tcp, strict=True)]
        far_m, turn = math.hypot(*way), goal_yaw - yaw
        there = far_m < NEAR_M and abs(turn) < NEAR_RAD
        if not there:
            self._since_s = time.monotonic()
        elif time.monotonic() - self._since_s > DWELL_S and len(self._waypoints) > 1:
            del self._waypoints[0]
            self._since_s = time.monotonic()
        share = min(1.0, STEP_M / max(far_m, STEP_M))
        step = [here + share * one for here, one in zip(tcp, way, strict=True)]
        return [*step, math.pi, 0.0, yaw + min(max(turn, -STEP_RAD), STEP_RAD), width_m]


# -- the worker -----------------------------------------------------------------------------------
class Newest:
    """The newest header and record of a key."""

    def __init__(self, node: Node, key: str) -> None:
        self._node = node
        self.sample: Any = None
        self._subscriber = node.session.declare_subscriber(f"{node.robot}/{key}", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            self.sample = read(sample)
        except Rejected as rejected:
            self._node.rejected[rejected.reason] += 1


class Worker(Node):
    """The node of the model."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        super().__init__(session, robot, f"worker-{WORKER}")
        self._task = Newest(self, "task")
        self._pose, self._gripper = Newest(self, "state/pose"), Newest(self, "state/gripper")
        self._objects = Newest(self, "sim/objects")
        self._spec = session.declare_queryable(f"{robot}/spec/{WORKER}", self._tell_spec)
        self._spec_s = 0.0
        self._model, self._episode = Model(), -1

    def _tell_spec(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, msgpack.packb(SPEC), encoding=MSGPACK)

    def run(self, ended: threading.Event) -> None:
        """Publish one chunk after the other, at the rate of the task."""
        while not ended.wait(self._step()):
            pass

    def _step(self) -> float:
        """One inference; how long to wait until the next, in s."""
        if time.monotonic() - self._spec_s > 1.0:
            self._spec_s = time.monotonic()
            self.publish(f"spec/{WORKER}", SPEC, NEWS)
        self.publish_status("running")
        streams = self._task, self._pose, self._gripper, self._objects
        newest = [stream.sample for stream in streams]
        if None in newest:
            return 0.1
        began_ns = time.time_ns()
        (_, task), (header, pose), (_, gripper), (_, objects) = newest
        if task["episode"] != self._episode:
            self._episode = task["episode"]
            poses = zip(objects["position_m"], objects["quat_xyzw"], strict=True)
            found = dict(zip(objects["names"], poses, strict=True))
            self._model.reset(task["prompt"], yaw_of(pose["quat_xyzw"]), found)
        step = self._model.infer(pose, gripper)
        chunk = {
            "worker": WORKER,
            "spec_hash": SPEC_HASH,
            "episode": task["episode"],
            "observation_stamp_ns": header["stamp_wall_ns"],
            "observation_seq": header["seq"],
            "valid_until_ns": header["stamp_wall_ns"] + VALID_NS,
            "steps": [step],
            "observed_ns": began_ns,
            "inference_start_ns": began_ns,
            "inference_end_ns": time.time_ns(),
        }
        self.publish(f"delta/{WORKER}", chunk, MUST_ARRIVE)
        return 1.0 / task["rate_hz"]


def main(endpoint: str = "tcp/127.0.0.1:7447", robot: str = "vla/panda") -> None:
    """Run until it is ended."""
    with open_session(endpoint) as session:
        Worker(session, robot).run(threading.Event())


if __name__ == "__main__":
    main(*sys.argv[1:])
