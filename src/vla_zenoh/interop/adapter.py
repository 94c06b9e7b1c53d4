"""What all adapters are: workers that ask a policy server, each over a wire of its own.

An adapter connects, asks, and takes the answer for what its options say. An answer is waited for no
longer than `timeout_s`. A connection on which anything went wrong is thrown away, so that no answer
is taken for that of a later question, and a lost server is tried again as `Backoff` says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop.backoff import Backoff
from vla_zenoh.interop.joints import Forward, make_forward
from vla_zenoh.interop.options import read_field_mapping, read_timeout
from vla_zenoh.interop.presets import Presets
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation
from vla_zenoh.profile import load_profile

ANSWERED = ("peer_error", "peer_reply")
"""Whoever says so is there, and is asked again soon."""


class Adapter(ABC):
    """See the module. A file in models/ has one subclass, with the options of its server.

    Args:
        name: of the model, for its spec.
        where: the server, for messages.
        presets: name -> options.
        preset: which of them.
        layout: options that override it, see `vla_zenoh.interop.options`.
        timeout_s: for connecting, and for each answer.
        profile: of the robot: its gripper and, where answers are joints, its arm.
        clock_s: seconds that only go forwards.
        normalisation: for the spec.

    Attributes:
        spec: what the options say.

    Raises:
        SpecError: an option is not known or cannot be; names what is allowed.
        ProfileError: the profile cannot be read.
    """

    joints: ClassVar[bool] = False
    """Whether its server may answer with joints."""
    lost: ClassVar[tuple[type[Exception], ...]] = (OSError,)
    """What its library raises when a connection cannot be had or was lost."""

    def __init__(
        self,
        name: str,
        where: str,
        presets: Presets,
        preset: str,
        mapping: Mapping[str, str],
        *,
        timeout_s: str,
        profile: str,
        clock_s: Callable[[], float],
        normalisation: str | None = None,
    ) -> None:
        self.where, self.timeout_s = where, read_timeout(timeout_s)
        self._profile = load_profile(profile)
        self.mapping = read_field_mapping(
            name,
            presets,
            preset,
            mapping,
            max_width_m=self._profile.robot.gripper.max_width_m,
            normalisation=normalisation,
        )
        if self.mapping.semantics.needs_joints and not self.joints:
            raise SpecError("action: joints are not read by this adapter; use delta or absolute")
        self.spec: ModelSpec = self.mapping.spec
        self._forward: Forward | None = None
        self._clock_s, self._backoff = clock_s, Backoff()
        self._begins = True

    # -- what a subclass has to know ----------------------------------------------------------
    @abstractmethod
    def _connect(self) -> Sequence[str]:
        """Make a connection where there is none, and say what does not fit in what it says.

        Raises:
            PeerError, or one of `lost`: there is no connection; `TimeoutError`: none in time.
        """

    @abstractmethod
    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        """The answer to one question.

        Args:
            fields: the server's names with pictures, numbers and text.
            begins: it is the first of an episode.

        Raises:
            PeerError, or one of `lost`: there is none; `TimeoutError`: none in time.
        """

    def _lose(self) -> None:
        """Throw away a connection on which something went wrong."""
        self.close()

    def close(self) -> None:
        """Let go of the connection, if there is one."""
        self.reset()  # the next one knows nothing of the episode

    # -- what a worker asks -------------------------------------------------------------------
    def load(self) -> None:
        """Kinematics, where they are needed; the server is asked with the first observation."""
        if self.mapping.semantics.needs_joints:
            self._forward = make_forward(self._profile)

    def reset(self) -> None:
        """An episode begins: the server is told with the next question, where it listens."""
        self._begins = True

    def infer(self, observation: Observation) -> ActionSteps:
        """One question, one answer.

        Raises:
            PeerError: there is no answer that can be used; says why.
        """
        wait_s = self._backoff.wait_s(self._clock_s())
        if wait_s > 0:
            raise PeerError("peer_gone", f"{self.where} was lost; tried again in {wait_s:.1f} s")
        try:
            return self.mapping.read(self._answer(observation), observation, self._forward)
        except Exception as error:  # whatever it was: what is left on the wire is never read
            self._drop(answers=isinstance(error, PeerError) and error.reason in ANSWERED)
            told = self._told(error)
            if told is error:
                raise
            raise told from error

    def _told(self, error: Exception) -> Exception:
        if isinstance(error, TimeoutError):
            why = f"{self.where} did not answer within {self.timeout_s:g} s"
            return PeerError("peer_timeout", why)
        if isinstance(error, self.lost):
            why = f"no connection to {self.where}: {str(error) or type(error).__name__}"
            return PeerError("peer_gone", why)
        return error

    def _answer(self, observation: Observation) -> Any:
        wrong = self._connect()
        if wrong:
            raise PeerError("peer_mismatch", f"{self.where} does not fit: {'; '.join(wrong)}")
        answer = self._ask(self.mapping.request(observation), begins=self._begins)
        self._begins = False
        self._backoff.succeeded()
        return answer

    def _drop(self, *, answers: bool = False) -> None:
        self._lose()
        self.reset()
        if answers:
            self._backoff.succeeded()
        self._backoff.failed(self._clock_s())
