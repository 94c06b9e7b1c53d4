"""Access check: every role can do what it must by the router's rules, and nothing else.

Zenoh drops silently what a rule forbids, so that a missing rule looks like a node that hangs. This
check reads the rules as Zenoh applies them; `access_rehearsal` tries the same acts with real
sessions at a real router.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from vla_zenoh.bus.session import covers
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile
from vla_zenoh.security.roles import (
    IN,
    MESSAGES,
    OUT,
    OWN,
    TABLE,
    Act,
    Identity,
    Role,
    access_control,
    expressions,
    identities,
    rights,
)


@dataclass(frozen=True, slots=True)
class Passage:
    """A message of one identity on its way through the router."""

    flow: str
    message: str
    key: str

    def __str__(self) -> str:
        return f"{self.flow} {self.message} {self.key}"


def passages(act: Act, key: str) -> list[Passage]:
    """What has to pass the router for `act` on `key`."""
    return [Passage(flow, message, key) for flow, message in MESSAGES[act]]


def allows(config: Mapping[str, Any], common_name: str, passage: Passage) -> bool:
    """Whether a section ``access_control`` lets a message of `common_name` pass.

    Reads certificates' names as subjects, which is what `access_control` makes. Of two rules that
    apply the one that denies wins, as in Zenoh.
    """
    if not config.get("enabled", False):
        return True
    verdicts = {rule["permission"] for rule in _applying(config, common_name, passage)}
    if "deny" in verdicts:
        return False
    return "allow" in verdicts or config.get("default_permission") == "allow"


def allowing(config: Mapping[str, Any], common_name: str, passage: Passage) -> list[str]:
    """Names of the rules by which a message of `common_name` passes."""
    found = _applying(config, common_name, passage)
    return [str(rule["id"]) for rule in found if rule["permission"] == "allow"]


def _applying(
    config: Mapping[str, Any], common_name: str, passage: Passage
) -> list[Mapping[str, Any]]:
    subjects = {
        subject["id"]
        for subject in config.get("subjects") or ()
        if common_name in (subject.get("cert_common_names") or (common_name,))
    }
    ruled = {
        rule
        for policy in config.get("policies") or ()
        if subjects.intersection(policy["subjects"])
        for rule in policy["rules"]
    }
    return [
        rule
        for rule in config.get("rules") or ()
        if rule["id"] in ruled
        and passage.flow in (rule.get("flows") or (IN, OUT))
        and passage.message in rule["messages"]
        and any(covers(key, passage.key) for key in rule["key_exprs"])
    ]


def missing(config: Mapping[str, Any], identity: Identity, act: Act, key: str) -> list[Passage]:
    """Messages that `identity` needs for `act` on `key` and `config` drops."""
    return [
        passage
        for passage in passages(act, key)
        if not allows(config, identity.common_name, passage)
    ]


RobotIdentity = tuple[Keys, Identity]
"""An identity at one robot."""


@dataclass(frozen=True, slots=True)
class AccessVerdict:
    """Result of the access check for one identity.

    Args:
        must: number of acts that it must be able to do.
        must_not: number of acts that it must not be able to do.
        faults: each a sentence with the rule that is missing or too much.
    """

    identity: Identity
    must: int
    must_not: int
    faults: tuple[str, ...]


def check_access(
    profile: Profile, access: Mapping[str, Any] | None = None, also: Sequence[Profile] = ()
) -> list[AccessVerdict]:
    """Check every act on every key for every identity.

    Args:
        access: section ``access_control`` to check; None: the one made of the profiles.
        also: other robots of the router; every identity of each is checked on the keys of all.
    """
    profiles = (profile, *also)
    rules = dict(access_control(profiles) if access is None else access)
    keys_of = probes(profiles)
    return [_verdict(played, keys_of, rules) for played in identities_of_all(profiles).values()]


def identities_of_all(profiles: Sequence[Profile]) -> dict[str, list[RobotIdentity]]:
    """Common name -> its identity at every robot where it has one; without routers."""
    out: dict[str, list[RobotIdentity]] = {}
    for profile in profiles:
        for one in identities(profile):
            if one.role is not Role.ROUTER:
                out.setdefault(one.common_name, []).append((profile.keys_of_all_parts, one))
    return out


def probes(profiles: Sequence[Profile]) -> dict[Act, list[str]]:
    """Act -> every key of the lab on which some identity may do it or its counterpart.

    Every key of PUT is also checked with DELETE; tokens are watched all at once.
    """
    made: dict[str, set[Act]] = {}
    for profile in profiles:
        camera = next(iter(profile.cameras), "front")
        for (member, allowed), identity in product(TABLE.items(), identities(profile)):
            for act in OWN & set(allowed):
                for key in expressions(profile.keys_of_all_parts, member, identity, act):
                    made.setdefault(key.replace("*", camera), set()).update(allowed)
    keys_of = {act: sorted(key for key, acts in made.items() if act in acts) for act in Act}
    watched = [one for profile in profiles for one in token_selectors(profile.keys)]
    return {**keys_of, Act.DELETE: keys_of[Act.PUT], Act.WATCH: watched}


def token_selectors(keys: Keys) -> tuple[str, ...]:
    """Selectors of all liveliness tokens of a robot."""
    return keys.all_alive, keys.all_holding


def obligations(
    played: Sequence[RobotIdentity], keys_of: Mapping[Act, Sequence[str]]
) -> dict[tuple[Act, str], bool]:
    """(act, key) -> whether an identity must be able to do it; if not, it must not."""
    granted = [right for keys, one in played for right in rights(keys, one)]
    read_all = [keys.all_keys for keys, one in played if Role.OPERATOR in one.roles]
    return {
        (act, key): (act is Act.SUBSCRIBE and any(covers(each, key) for each in read_all))
        or any(right.act is act and covers(right.key, key) for right in granted)
        for act, keys in keys_of.items()
        for key in keys
    }


def _verdict(
    played: Sequence[RobotIdentity], keys_of: Mapping[Act, Sequence[str]], rules: Mapping[str, Any]
) -> AccessVerdict:
    one = played[0][1]
    faults: list[str] = []
    wanted = obligations(played, keys_of)
    for (act, key), must in wanted.items():
        lacking = missing(rules, one, act, key)
        if must and lacking:
            why = f"no rule allows {', '.join(map(str, lacking))}"
            faults.append(f"{one.common_name} cannot {act.value} {key}: {why}")
        elif not (must or lacking):
            names = ", ".join(allowing(rules, one.common_name, passages(act, key)[0]))
            why = f"rule {names!r} allows it" if names else "nothing denies it"
            faults.append(f"{one.common_name} can {act.value} {key} and must not: {why}")
    count = sum(wanted.values())
    return AccessVerdict(one, count, len(wanted) - count, tuple(faults))
