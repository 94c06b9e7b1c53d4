"""Run on the robot's host: an operator who obeys JSON lines and answers with JSON lines.

    probe.py PROFILE

Orders: ``ready`` (activate, standing, prompt hold), ``move`` (put a prompt, wait until the arm is
under way), ``finish`` (wait until the motion has been carried out), ``recover`` (get the arm to
move again, activating it where it has to be), ``rest`` (deactivate), ``count`` (counters of all
nodes, and the command node's transitions since the last time).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import zenoh
from chain import READY_PATIENCE_S

from vla_zenoh.bus.buffers import header_of
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.profile import load_profile
from vla_zenoh.types import PoseState

MOVING_M_S, STILL_M_S = 0.05, 0.005
POLL_S = 0.005
TRY_S, SETTLE_S = 0.1, 0.6
FRESH_S, LATE_S = 0.2, 0.4
CATCH_UP_S = 2.0
"""A link that is slow for good never does."""
LOW_M, HIGH_M = 0.25, 0.62
AND_BACK = " within 0.25"
"""Without an end, and without reaching one of the arm's."""
EARLY = "refused.activate_refused"
"""What tells the person at the keyboard to wait is no refusal of the system's."""


class Probe:
    """See the module."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._payload = b""
        self._heard_s = -1e9
        self._stamp_ns = 0
        self._why = ""
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = client.session.declare_subscriber(client.keys.state_pose, handler)

    def _hear(self, sample: zenoh.Sample) -> None:
        with suppress(CodecError):
            self._stamp_ns = header_of(sample).stamp_wall_ns
            self._payload, self._heard_s = sample.payload.to_bytes(), time.monotonic()

    # -- orders -------------------------------------------------------------------------------
    def ready(self, rate_hz: float, patience_s: float = READY_PATIENCE_S) -> dict[str, Any]:
        """Active, standing, and asked for nothing."""
        give_up = time.monotonic() + patience_s
        while time.monotonic() < give_up:
            try:
                self._client.set_prompt("hold")
                self._client.set_rate(rate_hz)
                self._client.activate()
                return {"ready": True}
            except (SessionError, zenoh.ZError) as error:
                self._why = str(error)
                time.sleep(TRY_S)
        return {"ready": False, "why": self._why}

    def move(self, count: int = 0, patience_s: float = 5.0) -> dict[str, Any]:
        """Go where there is room, so many steps or without end."""
        up = self._height_m() < (LOW_M + HIGH_M) / 2
        start_m = self._reference()
        self._client.set_prompt(self._motion() + (f" x{count}" if count else AND_BACK))
        moving = self._until(lambda: self._speed_m_s() > MOVING_M_S, patience_s)
        return {
            "moving": moving,
            "start_m": start_m,
            "sign": 1 if up else -1,
            "why": self._saying(),
        }

    def finish(self, patience_s: float) -> dict[str, Any]:
        """Until the policy's last step is in force and the arm stands, or it obeys no more."""

        slow_since_s = [time.monotonic()]

        def ended() -> bool:
            command, now_s = self._client.status("command"), time.monotonic()
            if self._speed_m_s() > STILL_M_S:
                slow_since_s[0] = now_s
            if command is None or now_s - slow_since_s[0] < SETTLE_S:
                return False
            return command.state == "inactive" or bool(command.detail.get("policy_done"))

        ended_at_all = self._until(ended, patience_s)
        command = self._client.status("command")
        done = ended_at_all and command is not None and bool(command.detail.get("policy_done"))
        return {"done": done, "end_m": self._reference(), "why": self._saying()}

    def recover(self, patience_s: float) -> dict[str, Any]:
        """Make it move again; says whether it had to be activated, and when it was."""
        give_up = time.monotonic() + patience_s
        activated_s: float | None = None
        while time.monotonic() < give_up:
            if self._speed_m_s() > MOVING_M_S:
                return {"moves": True, "activated_s": activated_s, "why": self._why}
            try:
                state = self._state()
                if state in ("inactive", ""):
                    self._client.activate(timeout_s=1.0)
                    activated_s = activated_s or time.monotonic()
                if self._prompt() == "hold" or activated_s is not None:
                    self._client.set_prompt(self._motion() + AND_BACK)
            except (SessionError, zenoh.ZError) as error:
                self._why = str(error)
            self._until(lambda: self._speed_m_s() > MOVING_M_S, TRY_S)
        return {"moves": False, "activated_s": activated_s, "why": self._why}

    def rest(self) -> dict[str, Any]:
        """Deactivate, and wait until it stands."""
        return {"stands": self._client.deactivate(5.0)}

    def count(self) -> dict[str, Any]:
        """Refusals and lost records of every node, and what happened since the last time."""
        refused, lost = {}, {}
        for node, (status, _, _) in self._client.snapshot().items():
            for name, value in status.counters.items():
                if name.startswith("refused.") and name != EARLY:
                    refused[f"{node} {name.removeprefix('refused.')}"] = value
            net = status.detail.get("net", {})
            for key, value in net.get("lost", {}).items():
                lost[f"{node} {key}"] = value
        news = [
            [node, event.what, event.why]
            for node, _, event in self._client.pop_events()
            if event.kind == "transition" and node in ("command", "sim")
        ]
        return {"refused": refused, "lost": lost, "news": news, "alive": sorted(self._client.alive)}

    # -- looking ------------------------------------------------------------------------------
    def _state(self) -> str:
        status = self._client.status("command")
        return status.state if status else ""

    def _motion(self) -> str:
        """Towards where there is more room."""
        return f"HARD: go {'up' if self._height_m() < (LOW_M + HIGH_M) / 2 else 'down'}"

    def _saying(self) -> str:
        status = self._client.status("command")
        return f"{status.state}: {status.detail.get('why')}" if status else "no command node"

    def _prompt(self) -> str:
        task = self._client.task
        return task.prompt if task is not None else ""

    def newest(self) -> PoseState:
        """The newest state, waited for while the robot is silent.

        What a link held up arrives in a heap, and tells of a motion that may be over long since.
        """
        began_s = time.monotonic()
        while time.monotonic() - began_s < READY_PATIENCE_S:
            heard = time.monotonic() - self._heard_s < FRESH_S
            late = time.time_ns() - self._stamp_ns > LATE_S * 1e9
            if heard and (not late or time.monotonic() - began_s > CATCH_UP_S):
                break
            time.sleep(POLL_S)
        try:
            return records.decode(PoseState, self._payload)
        except CodecError as error:
            raise SessionError("no state is heard") from error

    def _height_m(self) -> float:
        return float(self.newest().position_m[2])

    def _speed_m_s(self) -> float:
        return float(np.linalg.norm(self.newest().twist[:3]))

    def _reference(self) -> list[float]:
        reference = self.newest().reference_position_m
        if reference is None:
            raise SessionError("the robot does not say what it follows")
        return reference.tolist()

    @staticmethod
    def _until(ask: Callable[[], bool], patience_s: float) -> bool:
        give_up = time.monotonic() + patience_s
        while time.monotonic() < give_up:
            if ask():
                return True
            time.sleep(POLL_S)
        return False


def main(name: str) -> None:
    profile = load_profile(name)
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = Client(profile, session).subscribe()
        probe = Probe(client)
        client.wait_for(lambda: client.status("command"), READY_PATIENCE_S)
        probe.newest()
        print(json.dumps({"listening": True}), flush=True)
        for line in sys.stdin:
            order = json.loads(line)
            answer = getattr(probe, order.pop("do"))(**order)
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
