"""Their client, and our stand-in for franka-node around their loop: by the Python that has them.

    python franka_node_process.py client ENDPOINT ARM
    python franka_node_process.py node ENDPOINT
    python franka_node_process.py router ENDPOINT

The loop is that of franka-rs, which franka-node itself runs. The stand-in has its lease, verbs,
watchdog, step and lead, by its documentation (tests/franka_node_peer.py); it dials ENDPOINT.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import franka_node_peer as peer

ROBOT = "127.0.0.1"
MODES = ("other", "idle", "move", "guiding", "reflex", "user_stopped", "automatic_error_recovery")
STEP_M, STEP_RAD, LEAD_M, LEAD_RAD, STEP_JOINT_RAD = 0.05, 0.26, 0.05, 0.26, 0.2
COLLISION = 40.0


def until_input_ends() -> None:
    print("READY", flush=True)
    sys.stdin.read()


class StandIn(peer.FrankaNode):
    """An arm of franka-sim, moved by franka-rs's target control with franka-node's defaults."""

    def __init__(self, endpoint: str) -> None:
        self._robot: Any = import_module("franka").Robot(ROBOT, realtime="ignore")
        self._control: Any = None
        self._lock = threading.Lock()
        state = self._robot.read_once()
        super().__init__(state.q, state.O_T_EE, "client", endpoint)

    def measure(self) -> None:
        with self._lock:
            control = self._control
            if control is None:
                return
            if control.running:
                self._take(control.state())
                return
            self._control = None
            self._finish(control)
            self.phase = peer.FAULTED

    def _take(self, state: Any) -> None:
        self.q, self.dq, self.effort = state.q, state.dq, state.tau_ext_hat_filtered
        self.ee, self.wrench, self.time_ms = (
            state.O_T_EE,
            state.O_F_ext_hat_K,
            int(state.time * 1e3),
        )
        self.rate, self.mode = state.control_command_success_rate, MODES.index(state.robot_mode)

    def _finish(self, control: Any) -> None:
        try:
            control.stop()
        except Exception as error:
            print(f"the loop ended: {error}", file=sys.stderr, flush=True)
        self._take(self._robot.read_once())

    def begin(self, *, joints: bool) -> None:
        robot = self._robot
        robot.set_collision_behavior_simple(*([COLLISION] * 7,) * 2, *([COLLISION] * 6,) * 2)
        control = robot.joint_targets(fraction=0.2) if joints else robot.cartesian_targets()
        with self._lock:
            self._joints, self._control = joints, control
            self._take(control.state())

    def end(self) -> None:
        with self._lock:
            control, self._control = self._control, None
            if control is None:
                return
            if self._joints:
                control.move_to(control.state().q)
            self._finish(control)

    def _do_recover(self, client: int) -> str:
        self._robot.automatic_error_recovery()
        self._take(self._robot.read_once())
        return super()._do_recover(client)

    def accepts(self, values: Any, before: Any) -> bool:
        if self._joints:
            return bool(np.abs(values - before).max() <= STEP_JOINT_RAD)
        measured = np.array([*self.ee[:3, 3], *peer.quat(self.ee)])
        return _near(values, before, STEP_M, STEP_RAD) and _near(values, measured, LEAD_M, LEAD_RAD)

    def follow(self, values: Any, *, joints: bool) -> None:
        with self._lock:
            if self._control is not None:
                self._control.move_to(values)


def _near(a: Any, b: Any, most_m: float, most_rad: float) -> bool:
    turn_rad = 2 * np.arccos(min(1.0, abs(a[3:] @ b[3:])))
    return bool(np.linalg.norm(a[:3] - b[:3]) <= most_m and turn_rad <= most_rad)


def be_node(endpoint: str) -> None:
    node = StandIn(endpoint)
    until_input_ends()
    node.close()


def be_router(endpoint: str) -> None:
    session = peer.opened(mode="router", listen__endpoints=[endpoint])
    until_input_ends()
    session.close()


def be_client(endpoint: str, name: str) -> None:
    """franka-node-client: one line in, a verb; one line out, what came of it, and the state."""
    theirs: Any = import_module("franka_node")
    with theirs.Node(endpoint) as node:
        arm = node.arm(name)
        arm.state(timeout=10.0)
        print("READY", flush=True)
        for line in sys.stdin:
            verb = json.loads(line)["verb"]
            try:
                if verb == "drive":
                    with arm.cartesian_targets(episode="theirs") as targets:
                        targets.move_by([0.0, 0.0, 0.01])
                        time.sleep(0.5)
                elif verb:
                    getattr(arm, verb)()
                said = "ok"
            except theirs.Refused as error:
                said = error.reason
            time.sleep(0.05)
            state = arm.state()
            told = {"said": said, "phase": state.phase, "holder": state.holder}
            told |= {"position": list(state.position), "q": list(state.q), "id": node.client_id}
            print(json.dumps(told), flush=True)


def encode(kind: str) -> None:
    """Their bytes of records with known values, in hex, one a line."""
    theirs: Any = import_module("franka_node._wire")
    values = [0.1 * number for number in range(1, 8)]
    print(theirs.encode_target(kind, 7, 3, 5, values, anchor=False).hex())
    print(theirs.encode_gripper("grasp", 7, 3, 5, 0.02, 25.0).hex())
    print(theirs.encode_request(7, mode=kind, episode="a-1"))


if __name__ == "__main__":
    role, *given = sys.argv[1:]
    {"node": be_node, "router": be_router, "client": be_client, "encode": encode}[role](*given)
