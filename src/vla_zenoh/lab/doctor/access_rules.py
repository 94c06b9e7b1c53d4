"""What a configuration of Zenoh's access control lets through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vla_zenoh.keys import covers
from vla_zenoh.security.identity import Identity
from vla_zenoh.security.roles import Act
from vla_zenoh.security.rules import IN, MESSAGES, OUT


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
