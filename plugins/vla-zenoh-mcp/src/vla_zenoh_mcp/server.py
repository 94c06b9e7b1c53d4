"""MCP server of one robot on stdio: its tools are the guarded primitives, state and pictures.

Calls run beside each other, so that ``stop`` is obeyed in a motion. When the client cancels a call
or closes its end, the arm brakes.
"""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from typing import IO, Any

from vla_zenoh import __version__
from vla_zenoh.client.client import StopOutcome
from vla_zenoh.client.primitives import ask
from vla_zenoh.client.remote_robot import RemoteRobot
from vla_zenoh.errors import SessionError, VlaZenohError, in_words
from vla_zenoh.keys import worker_node
from vla_zenoh.policy.meaning import joints_as
from vla_zenoh_mcp.protocol import (
    DESCRIPTIONS,
    LOOKING,
    MAX_LINE,
    Call,
    Cancelled,
    Id,
    Reply,
    read,
    said,
    success,
    tools,
)

MAX_CALLS = 8
BRAKE_S = 10.0
STATUS_S = 1.0
TOO_MANY = f"{MAX_CALLS} calls are running; wait for one"


class McpServer:
    """Reads requests from one stream and answers on the other.

    Args:
        out: where answers go, nothing else may write there.
        drives: the certificate is an operator's, or there are none; a viewer may only look.
    """

    def __init__(self, robot: RemoteRobot, out: IO[bytes], *, drives: bool) -> None:
        self._robot, self._out = robot, out
        allowed = list(DESCRIPTIONS) if drives else sorted(LOOKING)
        self._tools = tools(list(robot.profile.cameras), allowed)
        self._lock = threading.Lock()
        self._running: dict[Id, threading.Thread] = {}
        self._cancelled: set[Id] = set()
        self._over = False

    def serve(self, lines: IO[bytes]) -> None:
        """Answer until the stream of requests ends; then let go of the arm."""
        try:
            while line := lines.readline(MAX_LINE + 1):
                if line.strip():
                    self._take(line)
        finally:
            self._over = True
            for thread in list(self._running.values()):
                thread.join(BRAKE_S)

    def _take(self, line: bytes) -> None:
        asked = read(line, self._tools, __version__)
        if isinstance(asked, Reply):
            self._write(asked.line)
        elif isinstance(asked, Cancelled):
            with self._lock:
                if asked.id in self._running:
                    self._cancelled.add(asked.id)
        else:
            self._begin(asked)

    def _begin(self, call: Call) -> None:
        with self._lock:
            full = len(self._running) >= MAX_CALLS and call.name != "stop"
            if not full and call.id not in self._running:
                thread = threading.Thread(target=self._call, args=(call,), daemon=True)
                self._running[call.id] = thread
                thread.start()
                return
        why = TOO_MANY if full else f"request {call.id!r} is running"
        self._write(success(call.id, said({"error": why}, ok=False)))

    def _call(self, call: Call) -> None:
        try:
            result = self._result(call)
        except Exception as error:  # a wrong argument must not end the server
            why = str(error) if isinstance(error, VlaZenohError) else in_words(error)
            result = said({"error": why}, ok=False)
        with self._lock:
            self._running.pop(call.id, None)
            cancelled = call.id in self._cancelled
            self._cancelled.discard(call.id)
        if not cancelled:
            self._write(success(call.id, result))

    def _result(self, call: Call) -> dict[str, Any]:
        own: dict[str, Callable[..., dict[str, Any]]] = {
            "stop": self._stop,
            "state": self._state,
            "picture": self._picture,
        }
        if call.name in own:
            return own[call.name](**call.arguments)
        answer = ask(
            self._robot,
            call.name,
            call.arguments,
            who="mcp",
            cancelled=lambda: self._over or call.id in self._cancelled,
        )
        return said(asdict(answer), ok=answer.ok)

    def _stop(self, **_: Any) -> dict[str, Any]:
        with suppress(SessionError):  # what it would say is said below
            self._robot.stop()
        found = self._robot.stop_progress()
        text = found.sentence(f"robot {self._robot.profile.robot.name}")
        return said(
            {"outcome": found.outcome.value, "message": text},
            ok=found.outcome is StopOutcome.CONFIRMED,
        )

    def _picture(self, camera: Any = None) -> dict[str, Any]:
        known = self._robot.profile.cameras
        if camera not in known:
            raise SessionError(f"camera: {camera!r} is none of {', '.join(known)}")
        data = base64.b64encode(self._robot.picture(camera)).decode()
        image = {"type": "image", "data": data, "mimeType": "image/jpeg"}
        return {"content": [image], "isError": False}

    def _state(self) -> dict[str, Any]:
        robot = self._robot
        robot.wait_for(lambda: robot.task and robot.status("command"), STATUS_S)
        task, status = robot.task, robot.status("command")
        state = status.state if status is not None else "unknown"
        why = status.detail.get("why", "") if status is not None else ""
        try:
            pose, joint = robot.pose_state().record, robot.joint_state().record
            gripper = robot.gripper_state().record
        except SessionError as error:
            raise SessionError(
                f"{error}; the command node is {state}{why and f': {why}'}"
            ) from None
        joints_rad = joints_as(joint, "wrapped").position_rad
        box = robot.profile.limits.tcp_box
        worker = worker_node("")
        fields = {
            "robot": robot.profile.robot.name,
            "state": state,
            "why": why,
            "active": task is not None and task.active,
            "worker": task.worker if task is not None else "",
            "prompt": task.prompt if task is not None else "",
            "position_m": pose.position_m.tolist(),
            "quat_xyzw": pose.quat_xyzw.tolist(),
            "joints_rad": dict(zip(joint.names, joints_rad.tolist(), strict=True)),
            "gripper": None
            if gripper.width_m is None
            else {
                "width_m": gripper.width_m,
                "max_width_m": robot.profile.robot.max_width_m,
                "holding": gripper.holding,
            },
            "workers": sorted(n.removeprefix(worker) for n in robot.alive if n.startswith(worker)),
            "cameras": list(robot.profile.cameras),
            "workspace_m": {"x": box.x_m, "y": box.y_m, "z": box.z_m},
        }
        return said(fields, ok=True)

    def _write(self, line: str) -> None:
        if not line:
            return
        with self._lock:
            try:
                self._out.write(line.encode() + b"\n")
                self._out.flush()
            except (OSError, ValueError):
                self._over = True  # the client is gone
