"""What everybody in a lab tries, with a witness that may do everything: each act on every key."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh

from vla_zenoh.keys import Keys
from vla_zenoh.security.identity import Identity, Role
from vla_zenoh.security.roles import Act

SETTLE_S = 0.4
"""From a declaration until everybody who is concerned knows of it, on one computer."""
ANSWER_S = 2.0
WITNESS = Identity(Role.ROUTER, "witness", "rehearsal")
"""Hears and says everything, as routers do."""


def _listen(session: zenoh.Session, keys: Sequence[str], take: Callable[[Any], None]) -> list[Any]:
    handler = zenoh.handlers.Callback(take, indirect=False)
    return [session.declare_subscriber(key, handler) for key in keys]


def _end(declared: Sequence[Any]) -> None:
    for one in declared:
        one.undeclare()


def puts(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], keys: Sequence[str]
) -> set[tuple[str, Act, str]]:
    """What of each session's puts arrived at the witness, as (common name, act, key)."""
    heard: set[tuple[str, Act, str]] = set()
    listening = _listen(
        witness,
        keys,
        lambda sample: heard.add((sample.payload.to_string(), Act.PUT, str(sample.key_expr))),
    )
    # As nodes write: a publisher that is never told of a listener sends nothing.
    writing = [
        (name, session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK))
        for name, session in sessions.items()
        for key in keys
    ]
    time.sleep(SETTLE_S)
    for name, publisher in writing:
        publisher.put(name)
    time.sleep(SETTLE_S)
    matching = {
        (name, Act.PUT, str(publisher.key_expr))
        for name, publisher in writing
        if publisher.matching_status.matching  # pyright: ignore  # stub says bool
    }
    _end([*listening, *(publisher for _, publisher in writing)])
    return heard & matching


def deletions(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], keys: Sequence[str]
) -> set[tuple[str, Act, str]]:
    """Which of each session's deletions arrived at the witness. Nobody needs to be told of him."""
    heard: set[tuple[str, Act, str]] = set()

    def hear(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE and sample.attachment is not None:
            heard.add((sample.attachment.to_string(), Act.DELETE, str(sample.key_expr)))

    listening = _listen(witness, keys, hear)
    time.sleep(SETTLE_S)
    for name, session in sessions.items():
        for key in keys:
            session.delete(key, attachment=name, congestion_control=zenoh.CongestionControl.BLOCK)
    time.sleep(SETTLE_S)
    _end(listening)
    return set(heard)


def subscriptions(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], keys: Sequence[str]
) -> set[tuple[str, Act, str]]:
    """Which keys each session hears the witness on."""
    heard: set[tuple[str, Act, str]] = set()

    def hear(name: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: heard.add((name, Act.SUBSCRIBE, str(sample.key_expr)))

    listening = [
        one for name, session in sessions.items() for one in _listen(session, keys, hear(name))
    ]
    time.sleep(SETTLE_S)
    for key in keys:
        witness.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
    time.sleep(SETTLE_S)
    _end(listening)
    return set(heard)


def _serve(session: zenoh.Session, keys: Sequence[str], name: str) -> list[Any]:
    def reply(key: str) -> Callable[[zenoh.Query], None]:
        def handle(query: zenoh.Query) -> None:
            with query:
                query.reply(key, name)

        return handle

    return [
        session.declare_queryable(
            key, zenoh.handlers.Callback(reply(key), indirect=False), complete=True
        )
        for key in keys
    ]


def questions(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], keys: Sequence[str]
) -> set[tuple[str, Act, str]]:
    """Which keys each session is answered on by the witness."""
    serving = _serve(witness, keys, "witness")
    time.sleep(SETTLE_S)
    found = {
        (name, Act.ASK, key)
        for name, session in sessions.items()
        for key in keys
        if any(reply.ok is not None for reply in session.get(key, timeout=ANSWER_S))
    }
    _end(serving)
    return found


def answers(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], keys: Sequence[str]
) -> set[tuple[str, Act, str]]:
    """Which keys each session answers the witness on."""
    serving = [one for name, session in sessions.items() for one in _serve(session, keys, name)]
    time.sleep(SETTLE_S)
    found: set[tuple[str, Act, str]] = set()
    for key in keys:
        replies = witness.get(
            key,
            timeout=ANSWER_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        heard = [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]
        found |= {(name, Act.ANSWER, key) for name in heard}
    _end(serving)
    return found


def tokens(
    witness: zenoh.Session,
    sessions: Mapping[str, zenoh.Session],
    keys: Sequence[str],
    robots: Sequence[Keys],
) -> set[tuple[str, Act, str]]:
    """Which liveliness tokens of each session the witness sees."""
    found: set[tuple[str, Act, str]] = set()
    for name, session in sessions.items():
        tokens = [session.liveliness().declare_token(key) for key in keys]
        time.sleep(SETTLE_S)
        found |= {(name, Act.ANNOUNCE, key) for of in robots for key in alive(witness, of)}
        _end(tokens)
        time.sleep(SETTLE_S)
    return found


def watching(
    witness: zenoh.Session, sessions: Mapping[str, zenoh.Session], robots: Sequence[Keys]
) -> set[tuple[str, Act, str]]:
    """Whether each session sees the witness's liveliness tokens."""
    own = {
        expression: expression.replace("*", WITNESS.node)
        for of in robots
        for expression in tokens_of(of)
    }
    tokens = [witness.liveliness().declare_token(key) for key in own.values()]
    time.sleep(SETTLE_S)
    found = {
        (name, Act.WATCH, expression)
        for name, session in sessions.items()
        for expression, key in own.items()
        if key in _tokens(session, expression)
    }
    _end(tokens)
    return found


def tokens_of(keys: Keys) -> tuple[str, ...]:
    """Every selector of liveliness tokens of a robot."""
    return keys.all_alive, keys.all_holding


def alive(session: zenoh.Session, keys: Keys) -> set[str]:
    """Keys of all liveliness tokens of a robot that this session sees."""
    return {key for expression in tokens_of(keys) for key in _tokens(session, expression)}


def _tokens(session: zenoh.Session, expression: str) -> set[str]:
    replies = session.liveliness().get(expression, timeout=ANSWER_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
