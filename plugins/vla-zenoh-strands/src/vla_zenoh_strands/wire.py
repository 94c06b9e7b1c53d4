"""The wire of the strands-robots mesh: its keys, and its JSON. No Zenoh, no clock.

A mesh has a namespace, ``strands`` unless it was renamed, which Zenoh puts before every key: what
a peer calls ``strands/arm/cmd`` is ``strands/strands/arm/cmd`` on the bus.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vla_zenoh.errors import CodecError, CountedError

Message = dict[str, Any]
NAMESPACE = "strands"
MAX_COMMAND_BYTES = 16 * 1024
"""Their own bound of a command."""
MAX_PRESENCE_BYTES = 32 * 1024
MAX_ESTOP_BYTES = 64 * 1024
EVERYBODY = "<broadcast>\x00"
"""Target of a command that goes to all peers."""
DEFAULT_DURATION_S = 30.0
OUR_WORKER = "vla_zenoh"
"""Policy provider that means the worker which is chosen here."""
_PEER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_TURN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}")
_RESERVED = ("broadcast", "safety")
_TAKEN = frozenset(
    ("action", "instruction", "duration", "policy_provider", "policy_host", "turn_id", "sender_id")
)
"""Fields of an order that are understood; `policy_host` only where it names this computer, as
their clients always send it."""
_HERE = ("localhost", "127.0.0.1", "::1")


class RefusalError(CountedError):
    """An order is refused; `reason` is a stable name."""


def is_peer(name: object) -> bool:
    """Whether a peer can have this name: it becomes a part of keys."""
    return isinstance(name, str) and bool(_PEER.fullmatch(name)) and name not in _RESERVED


@dataclass(frozen=True)
class MeshKeys:
    """Keys of a mesh, with its namespace.

    Args:
        us: our peer's name.
        namespace: of the mesh.
    """

    us: str
    namespace: str = NAMESPACE

    @property
    def _root(self) -> str:
        return f"{self.namespace}/strands"

    @property
    def state(self) -> str:
        return f"{self._root}/{self.us}/state"

    @property
    def commands(self) -> str:
        return f"{self._root}/{self.us}/cmd"

    @property
    def broadcast(self) -> str:
        return f"{self._root}/broadcast"

    @property
    def estop(self) -> str:
        return f"{self._root}/safety/estop"

    @property
    def event(self) -> str:
        return f"{self._root}/{self.us}/safety/event"

    def presence(self, peer: str) -> str:
        return f"{self._root}/{peer}/presence"

    def response(self, peer: str, turn: str) -> str:
        return f"{self._root}/{peer}/response/{self.us}/{turn}"


@dataclass(frozen=True)
class Command:
    """A command to our peer.

    Args:
        sender: who says to have sent it; empty: nobody can be answered.
        turn: repeated by the answer.
        action: its verb.
        fields: the command itself.
        sent_s: when it was sent, wall clock of the sender; None: it does not say.
        body: the whole message, for its signature.
    """

    sender: str
    turn: str
    action: str
    fields: Message
    sent_s: float | None
    body: Message


@dataclass(frozen=True)
class Order:
    """What a peer wants done.

    Args:
        prompt: its instruction.
        duration_s: for how long the arm may follow the worker.
        worker: by name; empty: the one that is chosen here.
    """

    prompt: str
    duration_s: float
    worker: str = ""


def decode(payload: bytes) -> Message:
    """A message.

    Raises:
        CodecError: no JSON, or no object.
    """
    try:
        found = json.loads(payload, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise CodecError("malformed", f"no JSON: {error}") from error
    if not isinstance(found, dict):
        raise CodecError("malformed", f"a {type(found).__name__}, not an object of JSON")
    return found


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def number(value: object) -> float | None:
    """A finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) else None


def decode_command(payload: bytes) -> Command:
    """A command.

    Raises:
        CodecError: it is none, or names a sender or turn that is no part of a key.
    """
    body = decode(payload)
    sender, turn = body.get("sender_id", ""), body.get("turn_id", "none")
    if sender != "" and not is_peer(sender):
        raise CodecError("malformed", f"sender_id {sender!r:.80} is no name of a peer")
    if not isinstance(turn, str) or not _TURN.fullmatch(turn):
        raise CodecError("malformed", f"turn_id {turn!r:.80} cannot be a part of a key")
    fields = body.get("command")
    if not isinstance(fields, dict):
        raise CodecError("malformed", "its command is no object of JSON")
    action = fields.get("action", "status")
    if not isinstance(action, str):
        raise CodecError("malformed", f"action {action!r:.80} is no text")
    return Command(sender, turn, action, fields, number(body.get("timestamp")), body)


def order_of(fields: Mapping[str, Any], longest_s: float) -> Order:
    """The order in an ``execute`` or ``start``.

    Args:
        fields: the command.
        longest_s: more is refused.

    Raises:
        RefusalError: it asks for what is not done here.
    """
    more = sorted(set(fields) - _TAKEN)
    if more:
        raise RefusalError(
            "unsupported",
            f"{', '.join(map(str, more))}: not taken here; send instruction, duration and "
            "policy_provider",
        )
    if fields.get("policy_host", "localhost") not in _HERE:
        raise RefusalError("unsupported", "policy_host: policies are started by this robot's side")
    prompt = fields.get("instruction")
    if not isinstance(prompt, str) or not prompt.strip():
        raise RefusalError("invalid", "instruction has to be a text that is not empty")
    duration_s = number(fields.get("duration", DEFAULT_DURATION_S))
    if duration_s is None or not 0.0 < duration_s <= longest_s:
        raise RefusalError("invalid", f"duration has to be above 0 and at most {longest_s:g} s")
    worker = fields.get("policy_provider")
    if not isinstance(worker, str) or not worker:
        raise RefusalError(
            "invalid",
            f"policy_provider has to be a worker of this robot, or {OUR_WORKER!r} for the one that "
            "is chosen here",
        )
    return Order(prompt, duration_s, "" if worker == OUR_WORKER else worker)
