"""Tries with real sessions whether every role can do what it must, and nothing else.

Zenoh drops without a word what a rule forbids, so a rule that is missing looks like a node that
hangs. Here a router with the very rules of the profile is opened on this computer, with
certificates made for the occasion, and everybody in the lab tries everything on every key.
"""

from __future__ import annotations

import datetime as dt
import json
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SecurityError
from vla_zenoh.keys import Keys, covers
from vla_zenoh.profile import Profile
from vla_zenoh.profile.session import SecurityProfile
from vla_zenoh.security.identity import Identity, Role, identities
from vla_zenoh.security.roles import TABLE, Act, Right, expressions, rights
from vla_zenoh.security.rules import EVERY_MESSAGE, access_control, allowing, missing, passages
from vla_zenoh.security.store import Store

Tried = frozenset[tuple[str, Act, str]]
"""(common name, act, key) of what went through."""
Part = tuple[Keys, Identity]
"""At which robot somebody is what."""


@dataclass(frozen=True, slots=True)
class AccessVerdict:
    """What came of it for one identity.

    Args:
        identity: whose.
        must: how many things it must be able to do.
        must_not: how many it must not.
        faults: sentences, each with the rule that is missing or too much.
    """

    identity: Identity
    must: int
    must_not: int
    faults: tuple[str, ...]


def check_access(
    profile: Profile,
    access: Mapping[str, Any] | None = None,
    also: Sequence[Profile] = (),
) -> list[AccessVerdict]:
    """Try everything; takes some seconds.

    Args:
        profile: the lab.
        access: another section ``access_control`` than that which is made of the profiles.
        also: other robots that the router serves. Everybody of each tries the keys of all.

    Raises:
        MissingExtraError: the library ``cryptography`` is not installed.
        SecurityError: certificates cannot be made.
        SessionError: no sessions could be opened here, or a certificate was not accepted.
    """
    profiles = (profile, *also)
    parts = _parts(profiles)
    lab = [played[0][1] for played in parts.values()]
    rules = dict(access_control(profiles) if access is None else access)
    cast = probes(profiles)
    keys = [each.keys for each in profiles]
    with _stage(profile, lab, _with_witness(rules)) as (witness, sessions):
        went: Tried = frozenset().union(
            # First: a session that has had a publisher knows where nobody listens to it, and sends
            # nothing there, whatever the router would let through.
            deletions(witness, sessions, cast[Act.DELETE]),
            puts(witness, sessions, cast[Act.PUT]),
            subscriptions(witness, sessions, cast[Act.SUBSCRIBE]),
            questions(witness, sessions, cast[Act.ASK]),
            answers(witness, sessions, cast[Act.ANSWER]),
            tokens(witness, sessions, cast[Act.ANNOUNCE], keys),
            watching(witness, sessions, keys),
        )
    return [_judge(played, cast, rules, went) for played in parts.values()]


def _parts(profiles: Sequence[Profile]) -> dict[str, list[Part]]:
    """Common name -> what it is at each robot where it is somebody; without routers."""
    out: dict[str, list[Part]] = {}
    for profile in profiles:
        for one in identities(profile):
            if one.role is not Role.ROUTER:
                out.setdefault(one.common_name, []).append((profile.keys, one))
    return out


def probes(profiles: Sequence[Profile]) -> dict[Act, list[str]]:
    """Act -> every key of the lab on which somebody may do it or its counterpart.

    What is put may be tried to be deleted; tokens are watched all at once.
    """
    made: dict[str, set[Act]] = {}
    for profile in profiles:
        somewhere = next(iter(profile.cameras), "front")
        for row, identity in product(TABLE, identities(profile)):
            acts = {act for act in Act if row.roles(act)}
            for act in acts & {Act.PUT, Act.ANSWER, Act.ANNOUNCE}:
                for key in expressions(profile.keys, row.member, identity, act):
                    made.setdefault(key.replace("*", somewhere), set()).update(acts)
    cast = {act: sorted(key for key, acts in made.items() if act in acts) for act in Act}
    watched = [one for profile in profiles for one in tokens_of(profile.keys)]
    return {**cast, Act.DELETE: cast[Act.PUT], Act.WATCH: watched}


# -- the stage ------------------------------------------------------------------------------------
@contextmanager
def _stage(
    profile: Profile, lab: Sequence[Identity], rules: Mapping[str, Any]
) -> Iterator[tuple[zenoh.Session, dict[str, zenoh.Session]]]:
    """A router with `rules`, a witness, and a session for everybody."""
    with tempfile.TemporaryDirectory(prefix="vla-zenoh-rehearsal-") as folder, ExitStack() as stack:
        store, now = Store(folder), dt.datetime.now(dt.UTC)
        store.make_authority("rehearsal", now)
        router = Identity(Role.ROUTER, "router", WITNESS.host)
        store.add([router, WITNESS, *lab], now, days=1, addresses=["127.0.0.1"])
        endpoint = f"tls/127.0.0.1:{_free_port()}"
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
            mine = session.model_copy(update={"security": security})
            return stack.enter_context(open_session(mine, identity=one.node, **more))

        enter(router, mode="router", access=rules)
        witness = enter(WITNESS)
        yield witness, {one.common_name: enter(one) for one in lab}


def _with_witness(rules: Mapping[str, Any]) -> dict[str, Any]:
    more = access_control([])
    everything = {
        "id": "witness",
        "messages": list(EVERY_MESSAGE),
        "flows": ["ingress", "egress"],
        "permission": "allow",
        "key_exprs": ["**"],
    }
    subject = {"id": "witness", "cert_common_names": [WITNESS.common_name]}
    return {
        **more,
        **rules,
        "rules": [*(rules.get("rules") or ()), everything],
        "subjects": [*(rules.get("subjects") or ()), subject],
        "policies": [
            *(rules.get("policies") or ()),
            {"rules": ["witness"], "subjects": ["witness"]},
        ],
    }


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# -- the verdict ----------------------------------------------------------------------------------
def _judge(
    played: Sequence[Part],
    cast: Mapping[Act, Sequence[str]],
    rules: Mapping[str, Any],
    went: Tried,
) -> AccessVerdict:
    one = played[0][1]
    granted = [right for keys, part in played for right in rights(keys, part)]
    faults: list[str] = []
    count = {True: 0, False: 0}
    for act in Act:
        for key in cast[act]:
            must = _must(played, granted, act, key)
            count[must] += 1
            done = (one.common_name, act, key) in went
            if done != must:
                faults.append(_fault(rules, one, act, key, must=must))
    return AccessVerdict(one, count[True], count[False], tuple(faults))


def _must(played: Sequence[Part], granted: Sequence[Right], act: Act, key: str) -> bool:
    if act is Act.SUBSCRIBE and any(
        Role.OPERATOR in one.roles and covers(keys.all_keys, key) for keys, one in played
    ):
        return True
    return any(right.act is act and covers(right.key, key) for right in granted)


def _fault(rules: Mapping[str, Any], one: Identity, act: Act, key: str, *, must: bool) -> str:
    what = f"{one.common_name} {'cannot' if must else 'can'} {act.value} {key}"
    if must:
        lacking = ", ".join(map(str, missing(rules, one, act, key)))
        return (
            f"{what}: {f'no rule allows {lacking}' if lacking else 'Zenoh drops it all the same'}"
        )
    first = passages(act, key)[0]
    named = ", ".join(allowing(rules, one.common_name, first))
    return f"{what} and must not: {f'rule {named!r} allows it' if named else 'nothing denies it'}"


# -- the running router ---------------------------------------------------------------------------
def try_identity(profile: Profile, node: str | None) -> str:
    """Why the running router does not serve this computer's certificate for `node`; empty: it does.

    Args:
        profile: the lab.
        node: whose certificate; None: that of the people here.

    Raises:
        SessionError: no router answers, or it refuses the certificate.
        SecurityError: the certificate is not there.
    """
    with open_session(profile.session, identity=node) as session:
        if alive(session, profile.keys):
            return ""
    return (
        "the router takes the certificate and gives it nothing: it does not know this name. "
        "Start the router again with this profile, or see whether any node is up"
    )


def read_access(file: Path) -> dict[str, Any]:
    """The section ``access_control`` of a Zenoh configuration file.

    Raises:
        SecurityError: it cannot be read.
    """
    try:
        text = zenoh.Config.from_file(str(file)).get_json("access_control")
    except (zenoh.ZError, OSError) as error:
        raise SecurityError(f"{file} is no configuration of Zenoh: {error}") from error
    return dict(json.loads(text) or {})


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
