"""Access rehearsal: every identity of a lab tries every act on every key, with real sessions.

What `access_check` reads off the rules is tried here at a router on this
computer, with the rules of the profile and certificates of its own.
"""

from __future__ import annotations

import datetime as dt
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import zenoh
from access_check import (
    identities_of_all,
    obligations,
    probes,
    token_selectors,
)
from vla_zenoh_secure.lab_certificates import LabCertificates

from vla_zenoh.bus.session import open_session
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import SecurityProfile
from vla_zenoh.security.roles import EVERY_MESSAGE, Act, Identity, Role, access_control

Done = set[tuple[str, Act, str]]
"""(common name, act, key) of what went through."""
Sessions = Mapping[str, zenoh.Session]
"""Common name -> session."""

REPLY_S = 2.0
SETTLE_S = 0.4
"""From a declaration until all sessions on one computer know of it."""
WITNESS = Identity(Role.ROUTER, "witness", "rehearsal")
"""Peer of every act; it may do everything, as routers may."""


def surprises(
    profile: Profile, access: Mapping[str, Any] | None = None, also: Sequence[Profile] = ()
) -> dict[str, list[tuple[str, Act, str]]]:
    """Common name -> what it can do and must not, or cannot do and must; takes some seconds.

    Args:
        profile: the lab.
        access: section ``access_control`` to try; None: the one made of the profiles.
        also: other robots of the router.
    """
    profiles = (profile, *also)
    parts = identities_of_all(profiles)
    rules = dict(access_control(profiles) if access is None else access)
    keys_of = probes(profiles)
    robots = [each.keys for each in profiles]
    lab = [played[0][1] for played in parts.values()]
    with _stage(profile, lab, _with_witness(rules)) as (witness, sessions):
        done: Done = set().union(
            # First: a session that has had a publisher on a key without a subscriber sends nothing
            # there, whatever the router would let through.
            _deletions(witness, sessions, keys_of[Act.DELETE]),
            _puts(witness, sessions, keys_of[Act.PUT]),
            _subscriptions(witness, sessions, keys_of[Act.SUBSCRIBE]),
            _queries(witness, sessions, keys_of[Act.ASK]),
            _replies(witness, sessions, keys_of[Act.ANSWER]),
            _tokens(witness, sessions, keys_of[Act.ANNOUNCE], robots),
            _watched_tokens(witness, sessions, robots),
        )
    return {
        name: [
            ("can" if (name, act, key) in done else "cannot", act, key)
            for (act, key), must in obligations(played, keys_of).items()
            if ((name, act, key) in done) != must
        ]
        for name, played in parts.items()
    }


# -- router and sessions --------------------------------------------------------------------------
@contextmanager
def _stage(
    profile: Profile, lab: Sequence[Identity], rules: Mapping[str, Any]
) -> Iterator[tuple[zenoh.Session, Sessions]]:
    """A router with `rules`, a witness, and a session for every identity."""
    with tempfile.TemporaryDirectory(prefix="vla-zenoh-rehearsal-") as folder, ExitStack() as stack:
        store, now = LabCertificates(folder), dt.datetime.now(dt.UTC)
        store.make_authority("rehearsal", now)
        router = Identity(Role.ROUTER, "router", WITNESS.host)
        store.add([router, WITNESS, *lab], now, days=1, addresses=["127.0.0.1"])
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
        session = profile.session.model_copy(
            update={
                "connect": (endpoint,),
                "listen": (endpoint,),
                "separate_links": False,
                "insecure": False,
            }
        )

        def enter(one: Identity, **more: Any) -> zenoh.Session:
            security = SecurityProfile(folder=folder, host=one.host)
            own = session.model_copy(update={"security": security})
            return stack.enter_context(open_session(own, identity=one.node, **more))

        enter(router, mode="router", access=rules)
        witness = enter(WITNESS)
        yield witness, {one.common_name: enter(one) for one in lab}


def _with_witness(rules: Mapping[str, Any]) -> dict[str, Any]:
    everything = {
        "id": "witness",
        "messages": list(EVERY_MESSAGE),
        "flows": ["ingress", "egress"],
        "permission": "allow",
        "key_exprs": ["**"],
    }
    subject = {"id": "witness", "cert_common_names": [WITNESS.common_name]}
    policy = {"rules": ["witness"], "subjects": ["witness"]}
    return {
        **access_control([]),
        **rules,
        "rules": [*(rules.get("rules") or ()), everything],
        "subjects": [*(rules.get("subjects") or ()), subject],
        "policies": [*(rules.get("policies") or ()), policy],
    }


# -- acts: each returns what went through between a session and the witness -----------------------
def _subscribe(
    session: zenoh.Session, keys: Sequence[str], callback: Callable[[zenoh.Sample], None]
) -> list[Any]:
    handler = zenoh.handlers.Callback(callback, indirect=False)
    return [session.declare_subscriber(key, handler) for key in keys]


def _undeclare(declared: Sequence[Any]) -> None:
    for one in declared:
        one.undeclare()


def _puts(witness: zenoh.Session, sessions: Sessions, keys: Sequence[str]) -> Done:
    """Publications that the witness receives."""
    received: Done = set()
    subscribers = _subscribe(
        witness,
        keys,
        lambda sample: received.add((sample.payload.to_string(), Act.PUT, str(sample.key_expr))),
    )
    # Publishers, as in the nodes: one that learns of no subscriber sends nothing.
    publishers = [
        (name, session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK))
        for name, session in sessions.items()
        for key in keys
    ]
    time.sleep(SETTLE_S)
    for name, publisher in publishers:
        publisher.put(name)
    time.sleep(SETTLE_S)
    matching = {
        (name, Act.PUT, str(publisher.key_expr))
        for name, publisher in publishers
        if publisher.matching_status.matching  # pyright: ignore  # stub says bool
    }
    _undeclare([*subscribers, *(publisher for _, publisher in publishers)])
    return received & matching


def _deletions(witness: zenoh.Session, sessions: Sessions, keys: Sequence[str]) -> Done:
    """Deletions that the witness receives."""
    received: Done = set()

    def on_sample(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE and sample.attachment is not None:
            received.add((sample.attachment.to_string(), Act.DELETE, str(sample.key_expr)))

    subscribers = _subscribe(witness, keys, on_sample)
    time.sleep(SETTLE_S)
    for name, session in sessions.items():
        for key in keys:
            session.delete(key, attachment=name, congestion_control=zenoh.CongestionControl.BLOCK)
    time.sleep(SETTLE_S)
    _undeclare(subscribers)
    return set(received)


def _subscriptions(witness: zenoh.Session, sessions: Sessions, keys: Sequence[str]) -> Done:
    """Keys on which each session receives the witness."""
    received: Done = set()

    def callback(name: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: received.add((name, Act.SUBSCRIBE, str(sample.key_expr)))

    subscribers = [
        one
        for name, session in sessions.items()
        for one in _subscribe(session, keys, callback(name))
    ]
    time.sleep(SETTLE_S)
    for key in keys:
        witness.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
    time.sleep(SETTLE_S)
    _undeclare(subscribers)
    return set(received)


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


def _queries(witness: zenoh.Session, sessions: Sessions, keys: Sequence[str]) -> Done:
    """Queries that the witness replies to."""
    queryables = _serve(witness, keys, "witness")
    time.sleep(SETTLE_S)
    done = {
        (name, Act.ASK, key)
        for name, session in sessions.items()
        for key in keys
        if any(reply.ok is not None for reply in session.get(key, timeout=REPLY_S))
    }
    _undeclare(queryables)
    return done


def _replies(witness: zenoh.Session, sessions: Sessions, keys: Sequence[str]) -> Done:
    """Replies to queries of the witness."""
    queryables = [one for name, session in sessions.items() for one in _serve(session, keys, name)]
    time.sleep(SETTLE_S)
    done: Done = set()
    for key in keys:
        replies = witness.get(
            key,
            timeout=REPLY_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        names = [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]
        done |= {(name, Act.ANSWER, key) for name in names}
    _undeclare(queryables)
    return done


def _tokens(
    witness: zenoh.Session, sessions: Sessions, keys: Sequence[str], robots: Sequence[Keys]
) -> Done:
    """Liveliness tokens that the witness sees."""
    done: Done = set()
    for name, session in sessions.items():
        tokens = [session.liveliness().declare_token(key) for key in keys]
        time.sleep(SETTLE_S)
        done |= {(name, Act.ANNOUNCE, key) for of in robots for key in _live_tokens(witness, of)}
        _undeclare(tokens)
        time.sleep(SETTLE_S)
    return done


def _watched_tokens(witness: zenoh.Session, sessions: Sessions, robots: Sequence[Keys]) -> Done:
    """Liveliness tokens of the witness that each session sees."""
    own = {
        selector: selector.replace("*", WITNESS.node)
        for of in robots
        for selector in token_selectors(of)
    }
    tokens = [witness.liveliness().declare_token(key) for key in own.values()]
    time.sleep(SETTLE_S)
    done = {
        (name, Act.WATCH, selector)
        for name, session in sessions.items()
        for selector, key in own.items()
        if key in _tokens_of(session, selector)
    }
    _undeclare(tokens)
    return done


def _live_tokens(session: zenoh.Session, keys: Keys) -> set[str]:
    return {key for selector in token_selectors(keys) for key in _tokens_of(session, selector)}


def _tokens_of(session: zenoh.Session, selector: str) -> set[str]:
    replies = session.liveliness().get(selector, timeout=REPLY_S)
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
