"""Answers of the guarded primitives: JSON, as their requests (`vla_zenoh_primitives.requests`)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

from pydantic import TypeAdapter, ValidationError

from vla_zenoh.errors import CodecError, describe_faults

MAX_ANSWER_BYTES = 64 * 1024
DEFAULT_TIMEOUT_S = 30.0
"""Of a primitive, for which a request names none."""


@dataclass(frozen=True)
class Answer:
    """How a primitive ended, and where the arm stands.

    Args:
        ok: the request was fulfilled.
        reason: short stable name: ``reached``; of a run the name of the condition; otherwise
            ``timeout``, ``bound`` (a limit stopped the motion), ``stopped``, ``fault``,
            ``deactivated``, ``ended`` (by the command node; `why` has details), or, before anything
            moved, ``busy``, ``rejected``, ``invalid``.
        why: a sentence; empty if there is nothing to add.
        took_s: duration.
        position_m: of the TCP in the base frame; None if unknown.
        quat_xyzw: of the TCP.
        joints_rad: name -> position.
        width_m: of the gripper.
        holding: it holds an object.
        off_m: distance from the target of a motion.
        off_rad: angle to it; of a motion of joints that are commanded the largest of theirs.
    """

    ok: bool
    reason: str
    why: str = ""
    took_s: float = 0.0
    position_m: Sequence[float] | None = None
    quat_xyzw: Sequence[float] | None = None
    joints_rad: Mapping[str, float] = field(default_factory=dict)
    width_m: float | None = None
    holding: bool = False
    off_m: float | None = None
    off_rad: float | None = None

    def encode(self) -> bytes:
        """The answer as JSON."""
        return json.dumps(asdict(self)).encode()


_ANSWER = TypeAdapter(Answer)


def decode_answer(payload: bytes) -> Answer:
    """Read an answer.

    Raises:
        CodecError: not an answer.
    """
    if len(payload) > MAX_ANSWER_BYTES:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {MAX_ANSWER_BYTES} are read")
    try:
        return _ANSWER.validate_json(payload)
    except ValidationError as error:
        raise CodecError("malformed", describe_faults(error, "answer", most=4)) from error
