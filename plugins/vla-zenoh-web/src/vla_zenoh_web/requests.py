"""What a browser may ask: JSON to checked requests. Pure."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from vla_zenoh.errors import CodecError
from vla_zenoh.types import MAX_TEXT

MAX_BYTES = 8192
"""Of one message; the longest is a prompt."""
MAX_STREAMS = 16
MAX_NUMBER = 1e9

Text = Annotated[str, Meta(max_length=MAX_TEXT)]
Number = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Share = Annotated[float, Meta(ge=-1, le=1)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
Level = Annotated[int, Meta(ge=0, lt=5)]


def _tag(name: str) -> str:
    return name.removesuffix("Request").lower()


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=_tag):
    """A request; its ``do`` is the first word of its class's name. All fields are required."""


class EnterRequest(PageRequest):
    token: Text


class StopRequest(PageRequest):
    pass


class SettingRequest(PageRequest):
    """Changes the robot, and waits for its confirmation."""


class MotionRequest(SettingRequest):
    """Changes how the arm moves: not while another page holds it."""


class ResetRequest(SettingRequest):
    pass


class PromptRequest(MotionRequest):
    text: Text


class WorkerRequest(MotionRequest):
    name: Text


class RateRequest(MotionRequest):
    hz: Number


class SpeedRequest(MotionRequest):
    percent: Number


class HeldRequest(MotionRequest):
    part: Text
    text: Text


class ActivateRequest(MotionRequest):
    pass


class DeactivateRequest(SettingRequest):
    pass


class PressRequest(PageRequest):
    """Begins a hold."""

    press: Count
    tick: Count


class HoldRequest(PressRequest):
    """`hand`: a button that moves the arm by hand; no model is to move it in its place."""

    hand: bool


class PrimitivePress(PressRequest, tag="primitive"):
    name: Literal["home", "open", "closed"]


class BeatRequest(PressRequest):
    """Extends a hold, with the motion by hand for as long as it is in force."""

    twist: tuple[Share, Share, Share, Share, Share, Share]
    opening: Share


class ReleaseRequest(PageRequest):
    pass


class JogRequest(MotionRequest):
    on: bool
    frame: Literal["base", "tcp"]
    level: Level
    part: Text


class RecordRequest(SettingRequest):
    on: bool
    verdict: Literal["success", "failure", "void", ""]
    note: Text


class GuideRequest(SettingRequest):
    """A step of the guide; `prompt` and `count` are of ``begin``."""

    step: Literal[
        "begin", "scene", "take", "end", "again", "success", "failure", "void", "finish", "cancel"
    ]
    prompt: Text
    count: Annotated[int, Meta(ge=1, le=1000)]


class InviteRequest(PageRequest):
    """Lets another person in, with a token of their own."""

    name: Text
    role: Literal["operator", "viewer"]


class SaveRequest(SettingRequest):
    note: Text


class LookRequest(PageRequest):
    streams: Annotated[list[Text], Meta(max_length=MAX_STREAMS)]
    hz: Number


class DrawnRequest(PageRequest):
    frame: Count


Changes = (
    ResetRequest
    | PromptRequest
    | WorkerRequest
    | RateRequest
    | SpeedRequest
    | HeldRequest
    | ActivateRequest
    | DeactivateRequest
    | JogRequest
    | RecordRequest
    | GuideRequest
    | SaveRequest
)
AnyRequest = (
    EnterRequest
    | StopRequest
    | InviteRequest
    | Changes
    | HoldRequest
    | PrimitivePress
    | BeatRequest
    | ReleaseRequest
    | LookRequest
    | DrawnRequest
)
_DECODER = msgspec.json.Decoder(AnyRequest)


def name_of(request: PageRequest) -> str:
    """The ``do`` of a request."""
    return str(request.__struct_config__.tag)


def parse(text: str) -> AnyRequest:
    """Read a message of a browser. Raises CodecError: it is no request; says what is wrong."""
    if len(text) > MAX_BYTES:
        raise CodecError("oversize", f"{len(text)} characters, at most {MAX_BYTES} are accepted")
    try:
        return _DECODER.decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise CodecError("malformed", str(error) or type(error).__name__) from error
