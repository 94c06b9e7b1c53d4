# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "eclipse-zenoh>=1.9,<2",
#     "numpy",
#     "pin>=4",
#     "vla-zenoh-policy-servers",
# ]
# ///
"""Queries a policy by origami-zenoh-v1: Zenoh queries through the router of the policy.

An answer must carry the number of its request. The policy's actions are joint positions in the
order of the profile's `robot.arm_joints`.
"""

from __future__ import annotations

import time
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from vla_zenoh_model_origami import wire
from vla_zenoh_policy_servers.adapter import Adapter
from vla_zenoh_policy_servers.message import MAX_PAYLOAD_BYTES

from vla_zenoh.errors import CodecError, PeerError, SpecError

if TYPE_CHECKING:
    import zenoh


class Origami(Adapter):
    """Client of an origami-zenoh policy.

    Args:
        url: the router, as tcp/HOST:PORT.
        session_id: the session the policy was started for.
        preset: north_right; see wire.py.
        timeout_s: for each answer.
        profile: of the robot, for its arm and gripper.
        layout: see vla_zenoh_policy_servers.field_mapping.
    """

    name, presets, joints = "origami", wire.PRESETS, True

    def __init__(
        self,
        url: str = "tcp/127.0.0.1:7447",
        session_id: str = "vla-zenoh",
        preset: str = "north_right",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        if not session_id:
            raise SpecError("session_id is empty; a policy is started for one")
        super().__init__(
            f"the policy behind {url}",
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
        )
        self._url, self._session_id = url, session_id
        self._session: zenoh.Session | None = None
        self._known = False

    def _connect(self) -> list[str]:
        if self._known:
            return []
        wrong = wire.mismatches(self._query("metadata"), self.mapping)
        self._known = not wrong
        return wrong

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        if begins:
            self._query("reset")
        return self._query("infer", fields)

    def _query(self, operation: wire.Operation, fields: dict[str, Any] | None = None) -> Any:
        import zenoh

        from vla_zenoh.bus.buffers import bytes_of

        request_id = uuid.uuid4().hex
        try:
            session = self._opened()
            asked_s = time.monotonic()
            replies = session.get(
                f"{wire.PROTOCOL}/{operation}",
                payload=wire.request(operation, request_id, self._session_id, fields),
                encoding=zenoh.Encoding(wire.ENCODING),
                congestion_control=zenoh.CongestionControl.DROP,
                timeout=self.timeout_s,
            )
            for reply in replies:
                found = reply.ok or reply.err
                payload = bytes_of(found.payload, MAX_PAYLOAD_BYTES) if found is not None else b""
                if reply.ok is None and payload == b"Timeout":
                    break
                return wire.read_answer(payload, operation, request_id)
        except CodecError as error:
            raise PeerError("peer_reply", f"the answer is too large: {error}") from error
        except zenoh.ZError as error:
            self.close()
            raise PeerError("peer_gone", f"no router at {self._url}: {error}") from error
        if time.monotonic() - asked_s < 0.5 * self.timeout_s:
            raise PeerError("peer_gone", f"no policy behind {self._url} answers {operation}")
        raise TimeoutError

    def _opened(self) -> zenoh.Session:
        import zenoh

        if self._session is None:
            config = zenoh.Config()
            for key, value in (
                ("mode", '"client"'),
                ("connect/endpoints", f'["{self._url}"]'),
                ("connect/timeout_ms", "0"),
                ("connect/exit_on_failure", "true"),
                ("scouting/multicast/enabled", "false"),
                ("transport/shared_memory/enabled", "false"),
            ):
                config.insert_json5(key, value)
            self._session = zenoh.open(config)
        return self._session

    def _lose(self) -> None:
        # The session is with the router, and answers carry the numbers of their requests.
        self._known = False

    def close(self) -> None:
        """Close the session."""
        import zenoh

        super().close()
        session, self._session = self._session, None
        if session is not None:
            with suppress(zenoh.ZError):
                session.close()
