"""Rights as a configuration of Zenoh's access control.

Zenoh checks messages where they enter and leave the router, so one right takes several rules. The
samples of a writer must enter, and it must *learn* of subscribers, or it never sends; the
declaration of a reader must enter, and the samples must leave. Messages without a rule
are dropped silently.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile
from vla_zenoh.security.identity import Identity, Role, identities
from vla_zenoh.security.roles import LOOKERS, TABLE, Act, expressions, rights

IN, OUT = "ingress", "egress"
WISHES = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
"""Leave the router with the key of the query, which may be wider than that of the reply."""

MESSAGES: Mapping[Act, Sequence[tuple[str, str]]] = {
    # what is done: (way through the router, message)
    Act.PUT: ((IN, "put"), (OUT, "declare_subscriber")),
    Act.DELETE: ((IN, "delete"),),
    Act.SUBSCRIBE: ((IN, "declare_subscriber"), (OUT, "put")),
    Act.ANSWER: ((IN, "declare_queryable"), (IN, "reply"), (OUT, "query")),
    Act.ASK: ((IN, "query"), (OUT, "declare_queryable"), (OUT, "reply")),
    Act.ANNOUNCE: (
        (IN, "liveliness_token"),
        (OUT, "declare_liveliness_subscriber"),
        (OUT, "liveliness_query"),
    ),
    Act.WATCH: (
        (IN, "declare_liveliness_subscriber"),
        (IN, "liveliness_query"),
        (OUT, "liveliness_token"),
    ),
}
EVERY_MESSAGE = tuple(dict.fromkeys(message for ways in MESSAGES.values() for _, message in ways))


def access_control(profiles: Iterable[Profile]) -> dict[str, Any]:
    """Zenoh's section ``access_control`` for a router that serves the robots of these profiles.

    Whatever is not named is denied.
    """
    rules: dict[str, dict[str, Any]] = {}
    of_subject: dict[str, dict[str, None]] = {}
    for profile in profiles:
        for identity in identities(profile):
            own = of_subject.setdefault(identity.common_name, {})
            for made in _rules(identity, profile.keys_of_all_parts):
                rules.setdefault(made["id"], made)
                own[made["id"]] = None
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": [{"id": name, "cert_common_names": [name]} for name in of_subject],
        "policies": [{"rules": list(own), "subjects": [name]} for name, own in of_subject.items()],
    }


def _rules(identity: Identity, keys: Keys) -> list[dict[str, Any]]:
    if identity.role is Role.ROUTER:
        return [rule("router", (IN, OUT), EVERY_MESSAGE, ["**"])]
    granted: dict[tuple[str, str], dict[str, None]] = {}
    for right in rights(keys, identity):
        for flow, message in MESSAGES[right.act]:
            wish = flow == OUT and message in WISHES
            # A subscriber may ask for more than this key: the writer must still learn of it.
            key = "**" if wish else right.key
            granted.setdefault((flow, message), {})[key] = None
            if right.act is Act.SUBSCRIBE:
                granted[flow, message].update(dict.fromkeys(wide(keys, identity)))
            if right.act is Act.WATCH and flow == IN and identity.roles & LOOKERS:
                # They may ask which robots there are; the answer contains those they may know.
                granted[flow, message][keys.all_robots] = None
    who = f"{keys.root}/{keys.robot}:{identity.common_name}"
    return [
        rule(f"{who}:{flow}:{message}", (flow,), (message,), found)
        for (flow, message), found in granted.items()
    ]


def wide(keys: Keys, identity: Identity) -> list[str]:
    """Key expressions with which an operator may subscribe to many keys at once.

    Zenoh allows a subscription only as a whole. An operator reads everything. A viewer may ask for
    all of a group, as ``state/*``, where it may read each of its keys.
    """
    if Role.OPERATOR in identity.roles:
        return [keys.all_keys]
    if identity.role is not Role.VIEWER:
        return []
    groups: dict[str, bool] = {}
    for member, allowed in TABLE.items():
        may = identity.role in allowed.get(Act.SUBSCRIBE, ())
        for key in expressions(keys, member, identity, Act.SUBSCRIBE):
            above, _, _ = key.rpartition("/")
            groups[above] = groups.get(above, True) and may
    top = keys.all_keys.removesuffix("/**")
    return [f"{group}/*" for group, may in groups.items() if may and group != top]


def rule(
    name: str, flows: Iterable[str], messages: Iterable[str], keys: Iterable[str]
) -> dict[str, Any]:
    """A rule of Zenoh that allows `messages` on `keys`."""
    return {
        "id": name,
        "messages": list(messages),
        "flows": list(flows),
        "permission": "allow",
        "key_exprs": list(keys),
    }
