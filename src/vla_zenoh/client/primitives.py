"""A client's side of the guarded primitives: asks for one, and is the deadman while it runs."""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.client.answer import DEFAULT_TIMEOUT_S, MAX_ANSWER_BYTES, Answer, decode_answer
from vla_zenoh.client.client import Client
from vla_zenoh.errors import SessionError

MARGIN_S = 20.0
"""On top of a primitive's own time: for activation, brake and answer."""
POLL_S = 0.05
NO_NODE = (
    "nothing answers on {key}: the node primitives does not run, or this certificate may not query "
    "it. Start it with `vla-zenoh node primitives`, or name it in hosts.HOST.nodes of the profile"
)
LOST = (
    "the node primitives runs, but no answer of it on {key} came in time: this program or its link "
    "stood still, and the arm braked, or this certificate may not query it"
)


class PrimitiveError(SessionError):
    """A primitive did not do what was asked; nothing moved, or the arm was braked.

    Attributes:
        answer: with the reason, and where the arm stands.
    """

    def __init__(self, primitive: str, answer: Answer) -> None:
        super().__init__(f"{primitive}: {answer.reason}{answer.why and f': {answer.why}'}")
        self.answer = answer


def ask(
    client: Client,
    primitive: str,
    fields: Mapping[str, Any],
    *,
    who: str = "client",
    cancelled: Callable[[], bool] = lambda: False,
) -> Answer:
    """Ask for a primitive, and wait until it is over.

    The arm moves only while this waits: if the process ends, or the block is left, it brakes.

    Args:
        primitive: one of `vla_zenoh_primitives.requests.REQUESTS`.
        fields: of the request, without its holder.
        who: begins the name by which this client holds the arm.
        cancelled: polled; once it returns true, the deadman is released and the arm brakes.

    Raises:
        SessionError: no node answers, or only with an error.
    """
    holder = f"{who}-{secrets.token_hex(4)}"
    key, replies, over = client.keys.primitive(primitive), list[zenoh.Reply](), threading.Event()
    timeout_s = fields.get("timeout_s", DEFAULT_TIMEOUT_S)
    given = {name: value for name, value in fields.items() if value is not None}
    known = isinstance(timeout_s, (int, float)) and 0 < timeout_s <= 3600  # else it is rejected
    token: Any = client.session.liveliness().declare_token(client.keys.holding(holder))
    with ExitStack() as held:
        held.callback(token.undeclare)
        client.session.get(
            key,
            handler=zenoh.handlers.Callback(replies.append, over.set, indirect=False),
            payload=json.dumps({**given, "holder": holder}),
            timeout=(timeout_s if known else 0.0) + MARGIN_S,
        )
        while not over.wait(POLL_S):
            if cancelled():
                held.close()
    for reply in replies:
        if reply.ok is not None:
            return decode_answer(bytes_of(reply.ok.payload, MAX_ANSWER_BYTES))
    if replies and replies[0].err is not None:
        said = bytes_of(replies[0].err.payload, MAX_ANSWER_BYTES).decode("utf-8", "replace")
        raise SessionError(f"{primitive}: {said[:500]}")
    raise SessionError((LOST if "primitives" in client.alive else NO_NODE).format(key=key))
