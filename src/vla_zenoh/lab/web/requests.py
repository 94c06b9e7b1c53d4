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


class Request(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """A request; its ``do`` is the name of its class in small letters. All fields are required."""


class Enter(Request):
    token: Text


class Stop(Request):
    pass


class Setting(Request):
    """Changes the robot, and waits for its confirmation."""


class Reset(Setting):
    pass


class Prompt(Setting):
    text: Text


class Worker(Setting):
    name: Text


class Rate(Setting):
    hz: Number


class Speed(Setting):
    percent: Number


class Held(Setting):
    part: Text
    text: Text


class Activate(Setting):
    pass


class Deactivate(Setting):
    pass


class Press(Request):
    """Begins a hold."""

    press: Count
    tick: Count


class Hold(Press):
    pass


class Primitive(Press):
    name: Literal["home", "open", "closed"]


class Beat(Press):
    """Extends a hold, with the motion by hand for as long as it is in force."""

    twist: tuple[Share, Share, Share, Share, Share, Share]
    opening: Share


class Release(Request):
    pass


class Jog(Setting):
    on: bool
    frame: Literal["base", "tcp"]
    level: Level
    part: Text


class Record(Setting):
    on: bool
    verdict: Literal["success", "failure", "void", ""]
    note: Text


class Save(Setting):
    note: Text


class Look(Request):
    streams: Annotated[list[Text], Meta(max_length=MAX_STREAMS)]
    hz: Number


class Drawn(Request):
    frame: Count


Changes = (
    Reset | Prompt | Worker | Rate | Speed | Held | Activate | Deactivate | Jog | Record | Save
)
AnyRequest = Enter | Stop | Changes | Hold | Primitive | Beat | Release | Look | Drawn
_DECODER = msgspec.json.Decoder(AnyRequest)


def name_of(request: Request) -> str:
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
