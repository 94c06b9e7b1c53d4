# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "websockets>=15", "pin>=4", "example-robot-data>=6"]
# ///
"""Asks a policy server that speaks openpi's wire; also vllm-omni, and ``vla-zenoh serve openpi``.

An answer is waited for no longer than `timeout_s`. A connection that failed in any way is dropped
and never read again, so no answer is taken for that of a later question.
"""

from __future__ import annotations

import socket
import struct
import time
import uuid
from contextlib import ExitStack, suppress
from typing import Any
from urllib.parse import urlsplit

from websockets.exceptions import WebSocketException
from websockets.protocol import State
from websockets.sync.client import ClientConnection, connect

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop import openpi
from vla_zenoh.interop.backoff import Backoff
from vla_zenoh.interop.joints import make_forward
from vla_zenoh.interop.layout import Forward
from vla_zenoh.interop.options import read_layout, read_timeout
from vla_zenoh.interop.presets import OPENPI
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.profile import load_profile

CLOSE_S = 0.1


class OpenPi:
    """See the module.

    Args:
        url: of the server, as ws://HOST:PORT; wss:// likewise.
        preset: libero, droid or own; see vla_zenoh/interop/presets.py.
        timeout_s: for connecting, and for each answer.
        dialect: openpi, vllm (knows resets and sessions), auto: by the path of the URL.
        api_key: sent as ``Authorization: Api-Key``.
        profile: of the robot: its gripper and, where answers are joints, its arm.
        layout: see vla_zenoh/interop/options.py.
    """

    def __init__(
        self,
        url: str = f"ws://127.0.0.1:{openpi.PORT}",
        preset: str = "libero",
        timeout_s: str = "2",
        dialect: str = "auto",
        api_key: str = "",
        profile: str = "panda_sim",
        **layout: str,
    ) -> None:
        self._url = url if "://" in url else f"ws://{url}"
        if urlsplit(self._url).scheme not in ("ws", "wss"):
            raise SpecError(f"url is {url!r}, wanted ws://HOST:PORT or wss://HOST:PORT")
        if dialect not in ("auto", "openpi", "vllm"):
            raise SpecError(f"dialect is {dialect!r}, allowed: auto, openpi, vllm")
        path = urlsplit(self._url).path
        self._vllm = dialect == "vllm" or (dialect == "auto" and path == openpi.VLLM_PATH)
        self._timeout_s = read_timeout(timeout_s)
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else None
        self._profile = load_profile(profile)
        width_m = self._profile.robot.gripper.max_width_m
        self._layout = read_layout("openpi", OPENPI, preset, layout, max_width_m=width_m)
        self.spec = self._layout.spec
        self._forward: Forward | None = None
        self._connection: ClientConnection | None = None
        self._until_closed = ExitStack()
        self._backoff = Backoff()
        self._begins, self._session = True, ""

    def load(self) -> None:
        """Kinematics, where they are needed; the server is asked for with the first observation."""
        if self._layout.needs_joints:
            self._forward = make_forward(self._profile)

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
            answer = self._ask(observation)
            return self._layout.read(answer, observation, self._forward)
        except PeerError:
            self._drop()
            raise
        except TimeoutError as error:
            self._drop()
            raise PeerError(
                "peer_timeout", f"{self._url} did not answer within {self._timeout_s:g} s"
            ) from error
        except (OSError, WebSocketException) as error:
            self._drop()
            raise PeerError(
                "peer_gone", f"no connection to {self._url}: {error or type(error).__name__}"
            ) from error

    def _ask(self, observation: Observation) -> Any:
        connection = self._connected()
        if self._begins and self._vllm:
            self._session = uuid.uuid4().hex
            connection.send(openpi.reset_request())
            openpi.read_reset(self._receive(connection))
        self._begins = False
        fields = self._layout.request(observation)
        connection.send(openpi.request(fields, self._session if self._vllm else None))
        return openpi.read_answer(self._receive(connection))

    def _receive(self, connection: ClientConnection) -> bytes | str:
        return connection.recv(self._timeout_s)

    # -- the connection -----------------------------------------------------------------------
    def _connected(self) -> ClientConnection:
        if self._connection is not None:
            if self._connection.state is State.OPEN:
                return self._connection
            self.close()  # it was closed while nothing was asked: a server may do that
        connection = self._connection = self._until_closed.enter_context(
            connect(
                self._url,
                compression=None,
                max_size=openpi.MAX_BYTES,
                additional_headers=self._headers,
                proxy=None,
                open_timeout=self._timeout_s,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server that thinks does not answer pings
            )
        )
        # A stopped server reads nothing, and sending would wait for it without end.
        seconds = struct.pack("ll", int(self._timeout_s), int(self._timeout_s % 1 * 1e6))
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, seconds)
        wrong = openpi.mismatches(openpi.read_metadata(self._receive(connection)), self._layout)
        if wrong:
            raise PeerError("peer_mismatch", f"{self._url} does not fit: {'; '.join(wrong)}")
        self._backoff.succeeded()
        return connection

    def _drop(self) -> None:
        self.close()
        self._begins = True
        self._backoff.failed(time.monotonic())

    def close(self) -> None:
        """Let go of the connection."""
        connection, self._connection = self._connection, None
        if connection is not None:
            # Not the polite way, which waits for a server that may be stopped.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
            with suppress(OSError, WebSocketException):
                self._until_closed.close()
