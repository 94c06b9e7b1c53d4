# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "pyzmq>=26"]
# ///
"""Asks a GR00T policy server (N1.5, N1.6 and later) over ZeroMQ.

An answer is waited for no longer than `timeout_s`. A socket that failed in any way is thrown away,
so no answer is taken for that of a later question. Servers that speak in pickles are refused.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import zmq

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop import groot
from vla_zenoh.interop.backoff import Backoff
from vla_zenoh.interop.options import read_layout, read_timeout
from vla_zenoh.interop.presets import GROOT
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.profile import load_profile

VERSIONS: dict[str, groot.Version] = {"n1.5": "n1.5", "n1.6": "n1.6"}


class Groot:
    """See the module.

    Args:
        url: of the server, as tcp://HOST:PORT.
        version: n1.5 (flat names), n1.6 (nested ones; also N1.7).
        preset: libero or bridge; see vla_zenoh/interop/presets.py.
        timeout_s: for connecting, and for each answer.
        api_token: where the server wants one.
        profile: of the robot, for its gripper.
        layout: see vla_zenoh/interop/options.py. Pictures are video.NAME, states state.NAME.
    """

    def __init__(
        self,
        url: str = f"tcp://127.0.0.1:{groot.PORT}",
        version: str = "n1.6",
        preset: str = "libero",
        timeout_s: str = "2",
        api_token: str = "",
        profile: str = "panda_sim",
        **layout: str,
    ) -> None:
        self._url = url if "://" in url else f"tcp://{url}"
        if version not in VERSIONS:
            raise SpecError(f"version is {version!r}, allowed: {', '.join(VERSIONS)}")
        self._version: groot.Version = VERSIONS[version]
        self._token = api_token
        self._timeout_s = read_timeout(timeout_s)
        width_m = load_profile(profile).robot.gripper.max_width_m
        self._layout = read_layout("groot", GROOT, preset, layout, max_width_m=width_m)
        if self._layout.needs_joints:
            raise SpecError("action: joints are not read by this adapter; use delta or absolute")
        for name, source in self._layout.fields.items():
            prefix = groot.STATE if source.parts else "" if source.prompt else groot.VIDEO
            if not name.startswith(prefix):
                raise SpecError(f"map: {name!r} must begin with {prefix!r}")
        self.spec = self._layout.spec
        self._socket: zmq.Socket[Any] | None = None
        self._backoff = Backoff()
        self._begins = True

    def reset(self) -> None:
        """An episode begins: the server is told with the next observation, where it listens."""
        self._begins = True

    def infer(self, observation: Observation) -> ActionSteps:
        """One question, one answer.

        Raises:
            PeerError: there is no answer that can be used; says why.
        """
        wait_s = self._backoff.wait_s(time.monotonic())
        if wait_s > 0:
            raise PeerError("peer_gone", f"{self._url} was lost; tried again in {wait_s:.1f} s")
        try:
            actions = groot.read_actions(self._asked(observation))
            return self._layout.read(actions, observation)
        except PeerError:
            self._drop()
            raise
        except zmq.ZMQError as error:
            self._drop()
            raise PeerError("peer_gone", f"no connection to {self._url}: {error}") from error

    def _asked(self, observation: Observation) -> bytes:
        if self._socket is None:
            self._connect()
        if self._begins:
            data = groot.reset_data(self._version)
            if data is not None:
                groot.read_answer(self._call("reset", data))
        self._begins = False
        fields = self._layout.request(observation)
        return self._call("get_action", groot.observation(fields, self._version))

    def _call(self, endpoint: str, data: Any = None) -> bytes:
        assert self._socket is not None
        try:
            self._socket.send(groot.request(endpoint, data, self._token))
        except zmq.Again as error:
            raise PeerError("peer_gone", f"nobody answers at {self._url}") from error
        try:
            return self._socket.recv()
        except zmq.Again as error:
            raise PeerError(
                "peer_timeout", f"{self._url} did not answer within {self._timeout_s:g} s"
            ) from error

    # -- the socket ---------------------------------------------------------------------------
    def _connect(self) -> None:
        socket = self._socket = zmq.Context.instance().socket(zmq.REQ)
        milliseconds = int(self._timeout_s * 1000)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, milliseconds)
        socket.setsockopt(zmq.RCVTIMEO, milliseconds)
        socket.setsockopt(zmq.MAXMSGSIZE, groot.MAX_BYTES)
        # Without a server questions would be kept, and asked when it is there again.
        socket.setsockopt(zmq.IMMEDIATE, 1)
        socket.connect(self._url)
        try:
            modalities = groot.read_answer(self._call("get_modality_config"))
        except PeerError as error:
            if error.reason != "peer_error":
                raise
            modalities = None  # a server that does not know the question says nothing of itself
        wrong = groot.mismatches(modalities, self._layout)
        if wrong:
            raise PeerError("peer_mismatch", f"{self._url} does not fit: {'; '.join(wrong)}")
        self._backoff.succeeded()

    def _drop(self) -> None:
        self.close()
        self._begins = True
        self._backoff.failed(time.monotonic())

    def close(self) -> None:
        """Let go of the socket."""
        socket, self._socket = self._socket, None
        if socket is not None:
            with suppress(zmq.ZMQError):
                socket.close()
