# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "numpy",
#     "pin>=4",
#     "vla-zenoh-policy-servers",
#     "websockets>=15",
# ]
# ///
"""Queries a policy served by XPolicyLab (pi0.5, GR00T, RDT, SmolVLA and others) over WebSocket.

An activation is a trial: the server gets ``reset`` when it begins and, with the next one,
``trial_end`` when it is over.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vla_zenoh_model_xpolicylab import wire
from vla_zenoh_policy_servers.adapter import Adapter, address
from vla_zenoh_policy_servers.field_mapping import NONE
from vla_zenoh_policy_servers.websocket_client import WebSocketClient


class XPolicyLab(Adapter):
    """Client of an XPolicyLab policy server.

    Args:
        url: of the server, as ws://HOST:PORT or wss://HOST:PORT.
        preset: joint or pose, see wire.py; none: no defaults.
        case: action case for the server to prepare; empty: none.
        timeout_s: for connecting, and for each answer.
        profile: of the robot: its gripper and, if answers are joints, its arm.
        layout: see vla_zenoh_policy_servers.field_mapping. A name a/b/c is nested: c in b in a.
    """

    name, presets, joints = "xpolicylab", wire.PRESETS, True
    lost = WebSocketClient.lost

    def __init__(
        self,
        url: str = f"ws://127.0.0.1:{wire.PORT}",
        preset: str = "",
        case: str = "",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        super().__init__(
            address(url, "ws", "wss").geturl(),
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
        )
        wire.check_names(self.mapping, whole=preset != NONE)
        self._line = WebSocketClient(self.where, self.timeout_s, wire.MAX_BYTES)
        self._place = wire.Place(uuid.uuid4().hex, case)

    def _connect(self) -> list[str]:
        if not self._line.is_open:
            self.close()  # the server may have closed it while idle
            self._line.open()
            self._call("hello", {})
            if case := self._place.action_case_id:
                self._call("prepare_case", {"action_case_id": case})
        return []  # the server does not describe itself

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        if begins:
            if self._place.trial_id:
                self._call("trial_end", {"trial_id": self._place.trial_id})
            self._place = replace(self._place, trial_id=uuid.uuid4().hex, step=0)
            self._call("reset", {"trial_id": self._place.trial_id})
        answer = self._call("infer", {"observation": wire.observation(fields)})
        self._place = replace(self._place, step=self._place.step + 1)
        return wire.read_actions(answer)

    def _call(self, kind: wire.Request, payload: Mapping[str, Any]) -> dict[str, Any]:
        number = uuid.uuid4().hex
        frame = self._line.call(wire.request(kind, number, self._place, payload))
        return wire.read_answer(frame, kind, number)

    def close(self) -> None:
        """Close the connection; what the server knows of a trial ends with it."""
        super().close()
        self._line.close()
        self._place = replace(self._place, trial_id="", step=0)
