"""Base class of the adapters: models that query an external policy server.

An adapter sends an observation and converts the answer by its options. It waits for an answer for
at most `timeout_s`. A connection on which anything failed is closed, so that no answer is mistaken
for that of a later request; a lost server is retried with `Backoff`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar
from urllib.parse import SplitResult, urlsplit

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation
from vla_zenoh.policy.options import number
from vla_zenoh.profile import load_profile
from vla_zenoh.profile.schema import reachable_address
from vla_zenoh_policy_servers.field_mapping import read_field_mapping
from vla_zenoh_policy_servers.presets import Presets

FIRST_S = 0.25
LONGEST_S = 2.0
"""The robot holds meanwhile: retry soon, but not in a tight loop."""


def address(text: str, *schemes: str) -> SplitResult:
    """The option `url`; without a scheme the first of `schemes` is meant.

    Raises:
        SpecError: another scheme, or no host of this name can be.
    """
    wanted = " or ".join(f"{scheme}://HOST:PORT" for scheme in schemes)
    try:
        parts = urlsplit(text if "://" in text else f"{schemes[0]}://{text}")
        fits = parts.scheme in schemes and parts.port != 0
        reachable_address(parts.hostname or "")
    except ValueError as error:
        raise SpecError(f"url is {text!r}, wanted {wanted}: {error}") from error
    if not fits:
        raise SpecError(f"url is {text!r}, wanted {wanted}")
    return parts


class Backoff:
    """Exponential backoff: retries at once, then after `FIRST_S`, doubling up to `LONGEST_S`."""

    def __init__(self) -> None:
        self.failures = 0
        self._next_s = 0.0

    def wait_s(self, now_s: float) -> float:
        """Time until the next try, 0 if it is due."""
        return max(self._next_s - now_s, 0.0)

    def failed(self, now_s: float) -> None:
        """A try failed at `now_s`."""
        pause_s = min(FIRST_S * 2.0 ** min(self.failures, 16), LONGEST_S)
        self.failures += 1
        self._next_s = now_s + pause_s

    def succeeded(self) -> None:
        """The server answered: the next loss is retried at once."""
        self.failures, self._next_s = 0, 0.0


MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.01, 60.0
ANSWERED = ("peer_error", "peer_reply")
"""Reasons of a server that is alive, and is retried soon."""


class Adapter(ABC):
    """A model that queries a policy server; each subclass in models/ implements one protocol.

    Args:
        where: the server, for messages.
        preset: one of `presets`, or ``none``.
        mapping: options that override it, see `vla_zenoh_policy_servers.field_mapping`.
        timeout_s: for connecting, and for each answer.
        profile: of the robot: its gripper and, if answers are joints, its arm.
        normalisation: for the spec.
        clock_s: seconds that only go forwards.

    Raises:
        SpecError: unknown or invalid option; names what is allowed.
        ProfileError: invalid profile.
    """

    name: ClassVar[str]
    """Of the model, for its spec."""
    presets: ClassVar[Presets]
    joints: ClassVar[bool] = False
    """Whether its server may answer with joints."""
    lost: ClassVar[tuple[type[Exception], ...]] = (OSError,)
    """Exceptions of its library for a connection that failed or was lost."""

    def __init__(
        self,
        where: str,
        preset: str,
        mapping: Mapping[str, str],
        *,
        timeout_s: str,
        profile: str,
        normalisation: str | None = None,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.where, self.timeout_s = where, number("timeout_s", timeout_s)
        if not MIN_TIMEOUT_S <= self.timeout_s <= MAX_TIMEOUT_S:
            raise SpecError(
                f"timeout_s is {timeout_s!r}, wanted {MIN_TIMEOUT_S:g} to {MAX_TIMEOUT_S:g}: "
                "a late answer is useless"
            )
        self.mapping = read_field_mapping(
            self.name,
            self.presets,
            preset,
            mapping,
            profile=load_profile(profile),
            normalisation=normalisation,
        )
        if self.mapping.semantics.needs_joints and not self.joints:
            raise SpecError("action: joints are not read by this adapter; use delta or absolute")
        self.spec: ModelSpec = self.mapping.spec
        self._clock_s, self._backoff = clock_s, Backoff()
        self._begins = True

    # -- implemented by subclasses ------------------------------------------------------------
    @abstractmethod
    def _connect(self) -> Sequence[str]:
        """Connect if necessary; returns contradictions between server and mapping.

        Raises:
            PeerError, or one of `lost`: no connection; `TimeoutError`: none in time.
        """

    @abstractmethod
    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        """The server's answer to one request.

        Args:
            fields: of the request: images, numbers and text.
            begins: it is the first of an episode.

        Raises:
            PeerError, or one of `lost`: no answer; `TimeoutError`: none in time.
        """

    def _lose(self) -> None:
        """Close a connection on which something failed."""
        self.close()

    def close(self) -> None:
        """Close the connection, if there is one."""
        self.reset()  # the next connection starts an episode

    # -- called by the worker -----------------------------------------------------------------
    def reset(self) -> None:
        """Start an episode; a server that supports it gets the reset with the next request."""
        self._begins = True

    def infer(self, observation: Observation) -> ActionSteps:
        """Query the server.

        Raises:
            PeerError: no usable answer; says why.
        """
        wait_s = self._backoff.wait_s(self._clock_s())
        if wait_s > 0:
            raise PeerError("peer_gone", f"{self.where} was lost; retrying in {wait_s:.1f} s")
        try:
            wrong = self._connect()
            if wrong:
                raise PeerError("peer_mismatch", f"{self.where} does not match: {'; '.join(wrong)}")
            answer = self._ask(self.mapping.request(observation), begins=self._begins)
            self._begins = False
            self._backoff.succeeded()
            return self.mapping.read(answer)
        except Exception as error:  # after any failure, nothing left on the wire may be read
            self._lose()
            self.reset()
            if isinstance(error, PeerError) and error.reason in ANSWERED:
                self._backoff.succeeded()
            self._backoff.failed(self._clock_s())
            if isinstance(error, TimeoutError):
                why = f"{self.where} did not answer within {self.timeout_s:g} s"
                raise PeerError("peer_timeout", why) from error
            if isinstance(error, self.lost):
                why = f"no connection to {self.where}: {str(error) or type(error).__name__}"
                raise PeerError("peer_gone", why) from error
            raise
