"""Requests for guarded primitives: JSON, of clients in any language.

An invalid request is answered with what is wrong with which field.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from vla_zenoh.client.answer import DEFAULT_TIMEOUT_S
from vla_zenoh.codec.settings import MAX_HELD_M, MIN_HELD_M
from vla_zenoh.errors import CodecError, ProfileError, describe_faults, nearest
from vla_zenoh.keys import key_chunk
from vla_zenoh.policy.spec import MAX_JOINTS
from vla_zenoh.types import MAX_TEXT

MAX_REQUEST_BYTES = 16 * 1024
FURTHEST_M = 5.0
FURTHEST_RAD = 4 * math.pi
UNIT_TOLERANCE = 0.01


def _metres(value: float) -> float:
    if abs(value) > FURTHEST_M:
        raise ValueError(f"is {value:g}, at most {FURTHEST_M:g} m: positions are in metres")
    return value


def _radians(value: float) -> float:
    if abs(value) > FURTHEST_RAD:
        raise ValueError(
            f"is {value:g}, at most {FURTHEST_RAD:.3g} rad: joints are in rad (m where they slide)"
        )
    return value


def _unit(value: tuple[float, ...]) -> tuple[float, ...]:
    length = math.hypot(*value)
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise ValueError(f"has the length {length:.4g}, a rotation is a unit quaternion x, y, z, w")
    return tuple(part / length for part in value)


def _name(value: str) -> str:
    try:
        return key_chunk(value, "name")
    except ProfileError as error:
        raise ValueError(str(error)) from None


Metres = Annotated[float, AfterValidator(_metres)]
Point = Annotated[tuple[Metres, Metres, Metres], Field(description="x, y, z in m, base frame")]
Quaternion = Annotated[
    tuple[float, float, float, float],
    AfterValidator(_unit),
    Field(description="x, y, z, w of the TCP in the base frame"),
]
Name = Annotated[str, AfterValidator(_name)]
Radians = Annotated[float, AfterValidator(_radians)]
Joints = Annotated[
    tuple[Radians, ...],
    Field(min_length=1, max_length=MAX_JOINTS, description="all joints in rad, from the base on"),
]
NamedJoints = Annotated[
    dict[str, Radians],
    Field(min_length=1, max_length=MAX_JOINTS, description="name -> rad; the others stay"),
]
Edge = Annotated[float, Field(ge=MIN_HELD_M, le=MAX_HELD_M)]
Size = Annotated[tuple[Edge, Edge, Edge], Field(description="x, y, z in m, axes of the TCP")]
Width = Annotated[float, Field(ge=0, le=1)] | Literal["open", "closed"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class PrimitiveRequest(_Part):
    """What every request has.

    Args:
        holder: name of the asking client: as long as its liveliness token on `Keys.holding` is
            there the arm may move.
        timeout_s: then the arm is braked.
    """

    holder: Name
    timeout_s: float = Field(default=DEFAULT_TIMEOUT_S, gt=0, le=3600)


class MoveTo(PrimitiveRequest):
    """Move the TCP along a straight line to a pose, or the joints to positions.

    Args:
        position_m: of the TCP in the base frame.
        quat_xyzw: of the TCP; None: as it is.
        joints_rad: all joints in the order of the profile, or some of them by name.
    """

    position_m: Point | None = None
    quat_xyzw: Quaternion | None = None
    joints_rad: NamedJoints | Joints | None = None

    @model_validator(mode="after")
    def _one_target(self) -> MoveTo:
        posed = self.position_m is not None or self.quat_xyzw is not None
        if posed == (self.joints_rad is not None):
            raise ValueError(
                "wants one target: position_m (m), with or without quat_xyzw, or joints_rad (rad)"
            )
        return self


class Home(PrimitiveRequest):
    """Move the joints to the profile's ``robot.home_rad``."""


class Grip(PrimitiveRequest):
    """Open or close the gripper; the arm stands.

    Args:
        width_m: between the fingers, or ``open``, or ``closed``: until something is held.
        holds_m: size of what it holds afterwards, a box around the TCP that is kept from table,
            keep-outs and the arm itself until the gripper opens.
    """

    width_m: Width
    holds_m: Size | None = None


class TcpRegion(_Part):
    """A box that the TCP enters, in the base frame."""

    low_m: Point
    high_m: Point

    @model_validator(mode="after")
    def _has_a_size(self) -> TcpRegion:
        if any(low > high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError("low_m must not be above high_m")
        return self


class Until(_Part):
    """Conditions that end a run, whichever comes first.

    Args:
        gripper: it is ``open``, or ``closed`` or holding something.
        inside: the TCP is in this box.
        force_n: the force on the arm has changed by this since the start.
        still_s: neither arm nor gripper has moved for this long, after a first motion.
        done: the model reports that it is done.
    """

    gripper: Literal["open", "closed"] | None = None
    inside: TcpRegion | None = None
    force_n: float | None = Field(default=None, gt=0, le=1000)
    still_s: float | None = Field(default=None, gt=0, le=600)
    done: bool = False

    @property
    def names(self) -> list[str]:
        """Of the conditions that are set."""
        return [name for name in type(self).model_fields if getattr(self, name)]


class RunModel(PrimitiveRequest):
    """Let a model move the arm until a condition holds, or the time is over.

    Args:
        worker: that moves the arm.
        prompt: for it; None: the present one.
        until: conditions; without any the run ends by its time.
    """

    worker: Name
    prompt: str | None = Field(default=None, min_length=1, max_length=MAX_TEXT)
    until: Until = Until()


REQUESTS: Mapping[str, type[PrimitiveRequest]] = {
    "move_to": MoveTo,
    "home": Home,
    "grip": Grip,
    "run": RunModel,
}
"""Primitive -> its request."""


def decode_request(primitive: str, payload: bytes) -> PrimitiveRequest:
    """Read a request.

    Raises:
        CodecError: ``oversize``, ``malformed`` (no JSON, or no such primitive) or ``invalid``;
            names every wrong field.
    """
    if len(payload) > MAX_REQUEST_BYTES:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {MAX_REQUEST_BYTES} are read")
    kind = REQUESTS.get(primitive)
    if kind is None:
        there = f"there are {', '.join(REQUESTS)}"
        raise CodecError(
            "malformed",
            f"no primitive {primitive[:40]!r}{nearest(primitive[:40], REQUESTS)} {there}",
        )
    try:
        return kind.model_validate_json(payload or b"{}")
    except ValidationError as error:
        reason = "malformed" if error.errors()[0]["type"] == "json_invalid" else "invalid"
        why = describe_faults(error, "request", most=4)
        raise CodecError(reason, f"request {primitive}: {why}"[:MAX_TEXT]) from error
