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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SecurityError
from vla_zenoh.keys import Keys, covers
from vla_zenoh.lab.doctor import rehearsal_acts
from vla_zenoh.lab.doctor.rehearsal_acts import WITNESS
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


def rehearse(
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
            rehearsal_acts.deletions(witness, sessions, cast[Act.DELETE]),
            rehearsal_acts.puts(witness, sessions, cast[Act.PUT]),
            rehearsal_acts.subscriptions(witness, sessions, cast[Act.SUBSCRIBE]),
            rehearsal_acts.questions(witness, sessions, cast[Act.ASK]),
            rehearsal_acts.answers(witness, sessions, cast[Act.ANSWER]),
            rehearsal_acts.tokens(witness, sessions, cast[Act.ANNOUNCE], keys),
            rehearsal_acts.watching(witness, sessions, keys),
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
    watched = [one for profile in profiles for one in rehearsal_acts.tokens_of(profile.keys)]
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
        if rehearsal_acts.alive(session, profile.keys):
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
