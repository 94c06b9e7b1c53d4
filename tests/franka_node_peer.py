"""An arm on the wire of franka-node 0.4, written by hand: its lease, verbs, states and targets.

It shares nothing with the package that speaks to it but the libraries. The arm is at once where a
target puts it, and no target is refused; tests/rivals/franka_node_process.py has one that moves.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from typing import Any, Self

import numpy as np
import zenoh

PORT = 24407
ENDPOINT = f"tcp/127.0.0.1:{PORT}"
IDLE, ACQUIRED, ACTIVE, STOPPING, FAULTED, HOMING = range(6)
HOLD_S, STOP_S = 0.2, 2.0
"""Without an accepted target the node says so after the first, and stops after the second."""
MODE_IDLE, MODE_MOVE, MODE_GUIDING, MODE_REFLEX = 1, 2, 3, 4


def opened(**settings: Any) -> zenoh.Session:
    config = zenoh.Config()
    for name, value in ({"scouting__multicast__enabled": False} | settings).items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def quat(pose: Any) -> Any:
    """Quaternion xyzw of a (4, 4) pose."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose[:3, :3]
    matrix = [
        [xx - yy - zz, yx + xy, zx + xz, zy - yz],
        [yx + xy, yy - xx - zz, zy + yz, xz - zx],
        [zx + xz, zy + yz, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ]
    return np.linalg.eigh(np.array(matrix) / 3)[1][:, -1]


class FrankaNode:
    """Serves the arm ``fr3`` with joints `q` and the end effector at `ee`, at 100 Hz."""

    def __init__(self, q: Any, ee: Any, mode: str = "router", endpoint: str = ENDPOINT) -> None:
        self.q, self.ee = np.array(q, float), np.array(ee, float)
        self.dq, self.effort, self.wrench = np.zeros(7), np.zeros(7), np.zeros(6)
        self.time_ms, self.rate = 0, 1.0
        self.phase, self.mode, self.flags, self.holder = IDLE, MODE_IDLE, 0, 0
        self.refused = 0
        self.silent = self.garbled = self.deaf = self.stuck = False
        self.denied = ""
        """What ``enable`` is refused with."""
        self.alive: set[int] = set()
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.targets: list[tuple[Any, ...]] = []
        self.target_times_s: list[float] = []
        self.grips: list[tuple[Any, ...]] = []
        self.width_m, self.hand_flags = 0.04, 1
        self._accepted, self._target_at = 0, np.zeros(7)
        self._accepted_s = self._heard_s = 0.0
        end = "listen" if mode == "router" else "connect"
        self.session = opened(
            mode=mode, transport__link__tx__lease=1000, **{f"{end}__endpoints": [endpoint]}
        )
        key = "franka/fr3/{}".format
        self._states = self.session.declare_publisher(key("state"))
        self._hands = self.session.declare_publisher(key("gripper/state"))
        self._kept = [
            self.session.declare_queryable(key("cmd/*"), self._verb),
            self.session.declare_subscriber(key("target"), self._target),
            self.session.declare_subscriber(key("gripper/target"), self._grip),
            self.session.liveliness().declare_subscriber(key("lease/*"), self._lease, history=True),
        ]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _lease(self, sample: zenoh.Sample) -> None:
        client = int(str(sample.key_expr).rsplit("/", 1)[1])
        if sample.kind == zenoh.SampleKind.PUT:
            self.alive.add(client)
            return
        self.alive.discard(client)
        if client == self.holder:
            self._do_stop(client)
            self.holder = 0
            if self.phase == ACQUIRED:
                self.phase = IDLE

    def _verb(self, query: zenoh.Query) -> None:
        verb = str(query.key_expr).rsplit("/", 1)[1]
        assert query.payload is not None
        request = json.loads(query.payload.to_bytes())
        self.asked.append((verb, request))
        error = getattr(self, f"_do_{verb}")(request["client_id"])
        reply = {"ok": False, "error": error} if error else {"ok": True}
        query.reply(query.key_expr, json.dumps(reply))

    def _do_acquire(self, client: int) -> str:
        if client not in self.alive:
            return "no lease"
        if self.holder not in (0, client):
            return f"held by {self.holder}"
        self.holder, self.phase = client, ACQUIRED
        return ""

    def _do_enable(self, client: int) -> str:
        if client != self.holder:
            return f"client {client} is not the holder"
        if not self.denied:
            joints = self.asked[-1][1].get("mode") == "joints"
            self.begin(joints=joints)
            self._target_at = self.q if joints else np.array([*self.ee[:3, 3], *quat(self.ee)])
            self._accepted_s = self._heard_s = time.monotonic()
            self.phase, self.mode, self.flags, self.refused = ACTIVE, MODE_MOVE, 0, 0
        return self.denied

    def _do_stop(self, client: int) -> str:
        if self.phase != ACTIVE:
            return f"not allowed in phase {self.phase}"
        self.phase = STOPPING
        self.end()
        self.phase, self.mode = IDLE, MODE_IDLE
        return ""

    def _do_recover(self, client: int) -> str:
        self.phase, self.mode = IDLE, MODE_IDLE
        return ""

    def _do_release(self, client: int) -> str:
        self.holder, self.phase = 0, IDLE
        return ""

    def _target(self, sample: zenoh.Sample) -> None:
        target = struct.unpack("<BBHIQQ7d", sample.payload.to_bytes())
        if self.phase != ACTIVE:
            return
        if target[3] != self.holder:
            self.refused += 1
            return
        self._heard_s = time.monotonic()
        self.targets.append(target)
        self.target_times_s.append(self._heard_s)
        values = np.array(target[6:])
        if self.deaf or not self.accepts(values, self._target_at):
            self.refused += 1
            return
        self._accepted, self._target_at = self._accepted + 1, values
        self._accepted_s, self.flags = self._heard_s, 0
        self.follow(values, joints=target[1] == 2)

    # -- the arm ------------------------------------------------------------------------------
    def measure(self) -> None:
        """Bring the state up to date."""
        self.time_ms += 10

    def begin(self, *, joints: bool) -> None:
        """Begin a session."""

    def end(self) -> None:
        """End it: the arm stands afterwards."""

    def accepts(self, values: Any, before: Any) -> bool:
        """Whether a target is within the bounds."""
        return True

    def follow(self, values: Any, *, joints: bool) -> None:
        """Go to a target."""
        if self.stuck:
            return
        if joints:
            self.q = values
        else:
            self.ee[:3, 3] = values[:3]

    def _grip(self, sample: zenoh.Sample) -> None:
        self.grips.append(struct.unpack("<BBHIQQdd", sample.payload.to_bytes()))

    def _run(self) -> None:
        count = 0
        while not self._stop.wait(0.01):
            if self.silent:
                continue
            self.measure()
            if self.phase == ACTIVE:
                now_s = time.monotonic()
                self.flags = int(now_s - self._accepted_s > HOLD_S)
                if now_s - self._heard_s > STOP_S:
                    self._do_stop(0)
            count += 1
            now_ns = time.monotonic_ns()
            numbers = (*self.q, *self.dq, *self.effort, *self.ee.T.ravel(), *self.wrench)
            state = struct.pack(
                "<BBBBHIQQQQd7d7d7d16d6d7dQQQ",
                9 if self.garbled else 1,
                self.phase,
                self.mode,
                0,
                self.flags,
                self.holder,
                0,
                0,
                now_ns,
                self.time_ms,
                self.rate,
                *numbers,
                *self._target_at,
                self._accepted,
                self.refused,
                0,
            )
            self._states.put(state)
            if count % 5 == 0:
                hand = (1, self.hand_flags, 0, self.holder, now_ns, self.width_m, 0.0, 0.08)
                self._hands.put(struct.pack("<BBHIQddd", *hand))

    def verbs(self) -> list[str]:
        return [verb for verb, _ in self.asked]

    def close(self) -> None:
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self.session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
