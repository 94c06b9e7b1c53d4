# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "numpy",
#     "pin>=4",
#     "pyzmq>=26",
#     "vla-zenoh-policy-servers",
# ]
# ///
"""Queries a GR00T policy server (N1.5, N1.6 and later) over ZeroMQ.

Servers that send pickles are rejected.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any, cast, get_args

import zmq
from vla_zenoh_model_groot import wire
from vla_zenoh_policy_servers.adapter import Adapter, address

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.policy.options import one_of


class Groot(Adapter):
    """Client of a GR00T policy server.

    Args:
        url: of the server, as tcp://HOST:PORT.
        version: n1.5 (flat names), n1.6 (nested ones; also N1.7).
        preset: libero or bridge, see wire.py; none: no defaults.
        timeout_s: for connecting, and for each answer.
        api_token: if the server requires one.
        profile: of the robot: its gripper and, if answers are joints, its arm.
        layout: see vla_zenoh_policy_servers.field_mapping. Images are video.NAME, states
            state.NAME.
    """

    name, presets, joints = "groot", wire.PRESETS, True
    lost = (zmq.ZMQError,)

    def __init__(
        self,
        url: str = f"tcp://127.0.0.1:{wire.PORT}",
        version: str = "n1.6",
        preset: str = "",
        timeout_s: str = "2",
        api_token: str = "",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        super().__init__(
            address(url, "tcp").geturl(),
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
        )
        one_of("version", version, get_args(wire.Version))
        self._version: wire.Version = cast(wire.Version, version)
        self._token = api_token
        for name, source in self.mapping.fields.items():
            prefix = wire.STATE if source.parts else "" if source.prompt else wire.VIDEO
            if not name.startswith(prefix):
                raise SpecError(f"map: {name!r} must begin with {prefix!r}")
        self._socket: zmq.Socket[Any] | None = None

    def _connect(self) -> list[str]:
        if self._socket is not None:
            return []
        socket = self._socket = zmq.Context.instance().socket(zmq.REQ)
        milliseconds = int(self.timeout_s * 1000)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, milliseconds)
        socket.setsockopt(zmq.RCVTIMEO, milliseconds)
        socket.setsockopt(zmq.MAXMSGSIZE, wire.MAX_BYTES)
        # Without this, requests to an absent server would be queued and sent later.
        socket.setsockopt(zmq.IMMEDIATE, 1)
        socket.connect(self.where)
        try:
            modalities = wire.read_answer(self._call("get_modality_config"))
        except PeerError as error:
            if error.reason != "peer_error":
                raise
            modalities = None  # a server without this endpoint does not describe itself
        return wire.mismatches(modalities, self.mapping)

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        reset = wire.reset_data(self._version)
        if begins and reset is not None:
            wire.read_answer(self._call("reset", reset))
        asked = wire.observation(fields, self._version)
        return wire.read_actions(self._call("get_action", asked))

    def _call(self, endpoint: str, data: Any = None) -> bytes:
        assert self._socket is not None
        try:
            self._socket.send(wire.request(endpoint, data, self._token))
        except zmq.Again as error:
            raise PeerError("peer_gone", f"no answer from {self.where}") from error
        try:
            return self._socket.recv()
        except zmq.Again as error:
            raise TimeoutError from error

    def close(self) -> None:
        """Close the socket."""
        super().close()
        socket, self._socket = self._socket, None
        if socket is not None:
            with suppress(zmq.ZMQError):
                socket.close()
