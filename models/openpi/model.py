# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "numpy",
#     "pin>=4",
#     "vla-zenoh-policy-servers",
#     "websockets>=15",
# ]
# ///
"""Queries a policy server with openpi's protocol.

vllm-omni and ``vla-zenoh serve policy`` implement it as well.
"""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np
from vla_zenoh_model_openpi import wire
from vla_zenoh_policy_servers.adapter import Adapter, address
from vla_zenoh_policy_servers.websocket_client import WebSocketClient

from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.options import one_of


class OpenPi(Adapter):
    """Client of an openpi policy server.

    Args:
        url: of the server, as ws://HOST:PORT or wss://HOST:PORT.
        preset: libero, droid or own, see wire.py; none: no defaults.
        timeout_s: for connecting, and for each answer.
        dialect: openpi, vllm (knows resets and sessions), auto: by the path of the URL.
        api_key: sent as ``Authorization: Api-Key``.
        profile: of the robot: its gripper and, if answers are joints, its arm.
        layout: see vla_zenoh_policy_servers.field_mapping.
    """

    name, presets, joints = "openpi", wire.PRESETS, True
    lost = WebSocketClient.lost

    def __init__(
        self,
        url: str = f"ws://127.0.0.1:{wire.PORT}",
        preset: str = "",
        timeout_s: str = "2",
        dialect: str = "auto",
        api_key: str = "",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        server = address(url, "ws", "wss")
        super().__init__(
            server.geturl(),
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
        )
        one_of("dialect", dialect, ("auto", "openpi", "vllm"))
        by_path = server.path == wire.VLLM_PATH
        self._vllm = by_path if dialect == "auto" else dialect == "vllm"
        headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._line = WebSocketClient(self.where, self.timeout_s, wire.MAX_BYTES, headers)
        self._session: str | None = None
        self._takes_reset = self._vllm
        # The row of an answer cannot be restored from selected columns of it.
        whole = self.mapping.columns is None
        self.takes_committed = whole and self.spec.action.relative_to != "start"
        self._server_takes = False
        self._committed: Committed | None = None

    def _connect(self) -> list[str]:
        if self._line.is_open:
            return []
        self.close()  # the server may have closed it while idle
        self._line.open()
        metadata = wire.read_metadata(self._line.receive())
        self._takes_reset = self._vllm or wire.SPEC in metadata
        self._server_takes = metadata.get(wire.TAKES_COMMITTED) is True
        return wire.mismatches(metadata, self.mapping)

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        """Query the server; one of ours whose model takes the steps in execution gets them.

        Raises:
            PeerError: no usable answer; says why.
        """
        self._committed = committed
        return super().infer(observation)

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        if begins and self._takes_reset:
            self._session = uuid.uuid4().hex if self._vllm else None
            wire.read_reset(self._line.call(wire.reset_request()))
        committed = self._committed
        if committed is not None and self._server_takes:
            steps = self.mapping.semantics.rows(committed.steps).astype(np.float32)
            fields = {**fields, wire.COMMITTED: {"steps": steps, "frozen": committed.frozen}}
        return wire.read_answer(self._line.call(wire.request(fields, self._session)))

    def close(self) -> None:
        """Close the connection."""
        super().close()
        self._line.close()
