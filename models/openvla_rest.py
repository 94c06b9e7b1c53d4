# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""Asks OpenVLA's or OpenVLA-OFT's REST server: ``POST /act``.

Every question has a connection of its own, which is ended after `timeout_s` whatever the server
does, so no answer is taken for that of a later question.
"""

from __future__ import annotations

import http.client
import socket
import threading
import time
from contextlib import suppress
from urllib.parse import urlsplit

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop import openvla_rest
from vla_zenoh.interop.backoff import Backoff
from vla_zenoh.interop.options import read_layout, read_timeout
from vla_zenoh.interop.presets import OPENVLA_REST
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.profile import load_profile


class OpenVlaRest:
    """See the module.

    Args:
        url: of the server, as http://HOST:PORT; https:// likewise; /act is added.
        preset: bridge, libero or oft_libero; see vla_zenoh/interop/presets.py.
        unnorm_key: statistics the server unnormalises with, empty: its own choice.
        encoded: true: JSON within JSON, for servers without json_numpy on the wire.
        timeout_s: for each question.
        profile: of the robot, for its gripper.
        layout: see vla_zenoh/interop/options.py.
    """

    def __init__(
        self,
        url: str = f"http://127.0.0.1:{openvla_rest.PORT}",
        preset: str = "bridge",
        unnorm_key: str = "",
        encoded: str = "false",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **layout: str,
    ) -> None:
        self._url = url if "://" in url else f"http://{url}"
        parts = urlsplit(self._url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise SpecError(f"url is {url!r}, wanted http://HOST:PORT or https://HOST:PORT")
        self._secure, self._host, self._port = parts.scheme == "https", parts.hostname, parts.port
        self._path = parts.path.rstrip("/") or openvla_rest.PATH
        if encoded not in ("true", "false"):
            raise SpecError(f"encoded is {encoded!r}, allowed: true, false")
        self._unnorm_key, self._encoded = unnorm_key, encoded == "true"
        self._timeout_s = read_timeout(timeout_s)
        self._layout = read_layout(
            "openvla_rest",
            OPENVLA_REST,
            preset,
            layout,
            max_width_m=load_profile(profile).robot.gripper.max_width_m,
            normalisation=unnorm_key or None,
        )
        if self._layout.needs_joints:
            raise SpecError("action: joints are not read by this adapter; use delta or absolute")
        self.spec = self._layout.spec
        self._backoff = Backoff()

    def infer(self, observation: Observation) -> ActionSteps:
        """One question, one answer.

        Raises:
            PeerError: there is no answer that can be used; says why.
        """
        wait_s = self._backoff.wait_s(time.monotonic())
        if wait_s > 0:
            raise PeerError("peer_gone", f"{self._url} was lost; tried again in {wait_s:.1f} s")
        fields = self._layout.request(observation)
        body = openvla_rest.request(fields, self._unnorm_key, encoded=self._encoded)
        try:
            answer = openvla_rest.read_answer(*self._post(body))
            steps = self._layout.read(answer, observation)
        except PeerError:
            self._backoff.failed(time.monotonic())
            raise
        self._backoff.succeeded()
        return steps

    def _post(self, body: bytes) -> tuple[int, bytes]:
        kind = http.client.HTTPSConnection if self._secure else http.client.HTTPConnection
        connection = kind(self._host, self._port, timeout=self._timeout_s)
        late = threading.Event()

        def end(open_socket: socket.socket) -> None:
            late.set()
            with suppress(OSError):
                open_socket.shutdown(socket.SHUT_RDWR)

        timer: threading.Timer | None = None
        try:
            connection.connect()
            # The time-out of a socket is for one read; a server may give a byte a second.
            timer = threading.Timer(self._timeout_s, end, (connection.sock,))
            timer.daemon = True
            timer.start()
            headers = {"Content-Type": "application/json", "Connection": "close"}
            connection.request("POST", self._path, body, headers)
            response = connection.getresponse()
            answer = response.status, response.read(openvla_rest.MAX_BYTES + 1)
            if late.is_set():
                raise TimeoutError
            return answer
        except (OSError, http.client.HTTPException) as error:
            if late.is_set() or isinstance(error, TimeoutError):
                raise PeerError(
                    "peer_timeout", f"{self._url} did not answer within {self._timeout_s:g} s"
                ) from error
            raise PeerError(
                "peer_gone", f"no answer from {self._url}: {error or type(error).__name__}"
            ) from error
        finally:
            if timer is not None:
                timer.cancel()
            connection.close()
