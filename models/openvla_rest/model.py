# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "pin>=4", "vla-zenoh-policy-servers"]
# ///
"""Queries the REST server of OpenVLA or OpenVLA-OFT: ``POST /act``.

Every request has its own connection, which is closed after `timeout_s` whatever the server does.
"""

from __future__ import annotations

import http.client
import socket
import threading
from contextlib import suppress
from typing import Any

from vla_zenoh_model_openvla_rest import wire
from vla_zenoh_policy_servers.adapter import Adapter, address

from vla_zenoh.policy.options import yes_no


class OpenVlaRest(Adapter):
    """Client of an OpenVLA REST server.

    Args:
        url: of the server, as http://HOST:PORT or https://HOST:PORT; /act is added.
        preset: bridge, libero or oft_libero, see wire.py; none: no defaults.
        unnorm_key: statistics the server unnormalises with, empty: its own choice.
        encoded: yes: JSON within JSON, for servers without json_numpy on the wire.
        timeout_s: for each request.
        profile: of the robot, for its gripper.
        layout: see vla_zenoh_policy_servers.field_mapping.
    """

    name, presets = "openvla_rest", wire.PRESETS
    lost = (OSError, http.client.HTTPException)

    def __init__(
        self,
        url: str = f"http://127.0.0.1:{wire.PORT}",
        preset: str = "",
        unnorm_key: str = "",
        encoded: str = "no",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        self._url = address(url, "http", "https")
        super().__init__(
            self._url.geturl(),
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
            normalisation=unnorm_key or None,
        )
        self._unnorm_key, self._encoded = unnorm_key, yes_no("encoded", encoded)

    def _connect(self) -> list[str]:
        return []  # each request does, and the server does not describe itself

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        body = wire.request(fields, self._unnorm_key, encoded=self._encoded)
        return wire.read_answer(*self._post(body))

    def _post(self, body: bytes) -> tuple[int, bytes]:
        secure = self._url.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = kind(self._url.hostname or "", self._url.port, timeout=self.timeout_s)
        late = threading.Event()

        def end(open_socket: socket.socket) -> None:
            late.set()
            with suppress(OSError):
                open_socket.shutdown(socket.SHUT_RDWR)

        timer: threading.Timer | None = None
        try:
            connection.connect()
            # A socket's time-out is per read; a server may send a byte a second.
            timer = threading.Timer(self.timeout_s, end, (connection.sock,))
            timer.daemon = True
            timer.start()
            headers = {"Content-Type": "application/json", "Connection": "close"}
            path = self._url.path.rstrip("/") or wire.PATH
            connection.request("POST", path, body, headers)
            with connection.getresponse() as response:
                answer = response.status, response.read(wire.MAX_BYTES + 1)
        except self.lost as error:
            if late.is_set():
                raise TimeoutError from error
            raise
        finally:
            if timer is not None:
                timer.cancel()
            connection.close()
        if late.is_set():
            raise TimeoutError
        return answer
