# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "eclipse-zenoh>=1.9,<2", "pin>=4", "example-robot-data>=6"]
# ///
"""Asks a policy that answers Zenoh queries as origami-zenoh-v1 says, by way of the router it uses.

An answer is waited for no longer than `timeout_s` and must carry the number of its question. The
policy speaks of joints, so its actions become poses by the kinematics of the profile's arm.
"""

from __future__ import annotations

import time
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop import origami
from vla_zenoh.interop.backoff import Backoff
from vla_zenoh.interop.joints import make_forward
from vla_zenoh.interop.layout import Forward
from vla_zenoh.interop.options import read_layout, read_timeout
from vla_zenoh.interop.presets import ORIGAMI
from vla_zenoh.keys import origami_key
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.profile import load_profile

if TYPE_CHECKING:
    import zenoh


class Origami:
    """See the module.

    Args:
        url: the router, as tcp/HOST:PORT.
        session_id: the session the policy was started for.
        preset: north_right; see vla_zenoh/interop/presets.py.
        timeout_s: for each answer.
        profile: of the robot whose arm and gripper are meant.
        layout: see vla_zenoh/interop/options.py.
    """

    def __init__(
        self,
        url: str = "tcp/127.0.0.1:7447",
        session_id: str = "vla-zenoh",
        preset: str = "north_right",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **layout: str,
    ) -> None:
        if not session_id:
            raise SpecError("session_id is empty; a policy is started for one")
        self._url, self._session_id = url, session_id
        self._timeout_s = read_timeout(timeout_s)
        self._profile = load_profile(profile)
        width_m = self._profile.robot.gripper.max_width_m
        self._layout = read_layout("origami", ORIGAMI, preset, layout, max_width_m=width_m)
        self.spec = self._layout.spec
        self._forward: Forward | None = None
        self._session: zenoh.Session | None = None
        self._backoff = Backoff()
        self._known, self._begins = False, True

    def load(self) -> None:
        """Kinematics, where they are needed; the policy is asked with the first observation."""
        if self._layout.needs_joints:
            self._forward = make_forward(self._profile)

    def reset(self) -> None:
        """An episode begins: the policy is told with the next observation."""
        self._begins = True

    def infer(self, observation: Observation) -> ActionSteps:
        """One question, one answer.

        Raises:
            PeerError: there is no answer that can be used; says why.
        """
        wait_s = self._backoff.wait_s(time.monotonic())
        if wait_s > 0:
            raise PeerError("peer_gone", f"{self._where} was lost; tried again in {wait_s:.1f} s")
        try:
            if not self._known:
                self._check(self._ask("metadata"))
            if self._begins:
                self._ask("reset")
                self._begins = False
            actions = self._ask("infer", self._layout.request(observation))
            return self._layout.read(actions, observation, self._forward)
        except PeerError:
            # It may be another one when it answers again.
            self._known, self._begins = False, True
            self._backoff.failed(time.monotonic())
            raise

    def _check(self, metadata: Any) -> None:
        wrong = origami.mismatches(metadata, self._layout)
        if wrong:
            raise PeerError("peer_mismatch", f"{self._where} does not fit: {'; '.join(wrong)}")
        self._known = True
        self._backoff.succeeded()

    @property
    def _where(self) -> str:
        return f"the policy behind {self._url}"

    def _ask(self, operation: origami.Operation, observation: dict[str, Any] | None = None) -> Any:
        import zenoh

        request_id = uuid.uuid4().hex
        try:
            replies = self._opened().get(
                origami_key(operation),
                payload=origami.request(operation, request_id, self._session_id, observation),
                encoding=zenoh.Encoding(origami.ENCODING),
                congestion_control=zenoh.CongestionControl.DROP,
                timeout=self._timeout_s,
            )
            asked_s = time.monotonic()
            for reply in replies:
                found = reply.ok or reply.err
                payload = found.payload.to_bytes() if found is not None else b""
                if reply.ok is None and payload == b"Timeout":
                    break
                return origami.read_answer(payload, operation, request_id)
        except zenoh.ZError as error:
            self.close()
            raise PeerError("peer_gone", f"no router at {self._url}: {error}") from error
        if time.monotonic() - asked_s < 0.5 * self._timeout_s:
            raise PeerError("peer_gone", f"nobody behind {self._url} answers {operation}")
        raise PeerError(
            "peer_timeout", f"{self._where} did not answer within {self._timeout_s:g} s"
        )

    # -- the session --------------------------------------------------------------------------
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

    def close(self) -> None:
        """Let go of the session."""
        import zenoh

        session, self._session = self._session, None
        if session is not None:
            with suppress(zenoh.ZError):
                session.close()
