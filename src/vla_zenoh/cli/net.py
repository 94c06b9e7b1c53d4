"""vla-zenoh net."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from rich.table import Table

from vla_zenoh.bus.clock import Clock
from vla_zenoh.bus.clock_sync import ClockSync
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    JsonOption,
    ProfileOption,
    RobotOption,
)
from vla_zenoh.cli.output import console, fail, print_json, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import NodeStatus

HERE = "this computer"
NOBODY = "-"
POLL_S = 0.05
SHOWN_OF_BOOT = 8
"""Characters, which are drawn at random."""
MAX_NUMBER = 40
"""Characters: anybody may say 1e308."""


@dataclass(frozen=True, slots=True)
class HostPair:
    """Two hosts, as the first one sees the second.

    Args:
        seen_from: a host.
        host: the other one.
        by: node that measured, on the first.
        of: node that was asked, on the second.
        round_trip_ms: there and back, through the router.
        offset_ms: the second clock minus the first.
        uncertainty_ms: of that.
        links: of the measuring node, to its router.
    """

    seen_from: str
    host: str
    by: str
    of: str
    round_trip_ms: float
    offset_ms: float
    uncertainty_ms: float
    links: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Line:
    """What one node writes on one key.

    Args:
        key: short.
        node: who; "-" where nobody writes there now, and some records were lost before.
        host: where.
        rate_hz: records a second.
        bytes_s: bytes a second, once, however many listen.
        lost: listener -> records that never reached it.
    """

    key: str
    node: str
    host: str
    rate_hz: float
    bytes_s: float
    lost: dict[str, int]


def net(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=1.0, help="How long to listen.")
    ] = 3.0,
    as_json: JsonOption = False,
) -> None:
    """Show every pair of hosts: link, round trip, clock offset; and what each key costs."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.client() as client:
        clocks = ClockSync(
            client.session,
            client.keys,
            Clock(),
            HERE,
            client.profile.timing.max_clock_offset_s,
        )
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            for node in tuple(client.alive):
                clocks.track(node)
            clocks.tick()
            time.sleep(POLL_S)
        statuses = {name: found for name, (found, _, alive) in client.snapshot().items() if alive}
        own_links = tuple(sorted(str(link.dst) for link in client.session.info.links()))
        pairs = pairs_of(statuses, _own(clocks, statuses, own_links))
        lines = lines_of(statuses)
        why = "" if statuses else aim.silent(client, "net")
    bound_ms = client.profile.timing.max_clock_offset_s * 1e3
    if as_json:
        print_json({"hosts": pairs, "keys": lines, "max_clock_offset_ms": bound_ms})
    else:
        for table in tables(client.keys.robot, pairs, lines, bound_ms):
            console().print(table)
    if why:
        fail(why)


def _own(
    clocks: ClockSync, statuses: Mapping[str, NodeStatus], links: tuple[str, ...]
) -> list[HostPair]:
    """Each host as seen from here."""
    hosts = hosts_of(statuses)
    return [
        HostPair(
            HERE,
            hosts[node],
            "net",
            node,
            round(found.round_trip_s * 1e3, 3),
            round(found.offset_s * 1e3, 3),
            round(found.uncertainty_s * 1e3, 3),
            links,
        )
        for node, found in clocks.offsets().items()
        if node in statuses
    ]


def hosts_of(statuses: Mapping[str, NodeStatus]) -> dict[str, str]:
    """Node -> its host; where computers have the same name, with a piece of what tells them apart.

    Whoever starts a node by hand need not say which host of the profile that is, and computers of a
    laboratory are often copies of one, name included.
    """
    boots: dict[str, set[str]] = {}
    for status in statuses.values():
        boots.setdefault(status.host, set()).add(status.boot)
    return {
        name: status.host
        if len(boots[status.host]) == 1
        else f"{status.host} ({status.boot[:SHOWN_OF_BOOT] or 'unknown'})"
        for name, status in statuses.items()
    }


def pairs_of(statuses: Mapping[str, NodeStatus], own: list[HostPair]) -> list[HostPair]:
    """The best measurement of each pair of hosts: `own`, and what nodes tell."""
    best: dict[tuple[str, str], HostPair] = {}
    for pair in [*own, *_told(statuses)]:
        hosts = (pair.seen_from, pair.host)
        if hosts not in best or pair.uncertainty_ms < best[hosts].uncertainty_ms:
            best[hosts] = pair
    return [best[hosts] for hosts in sorted(best)]


def _told(statuses: Mapping[str, NodeStatus]) -> list[HostPair]:
    """What nodes say of nodes on other hosts."""
    out: list[HostPair] = []
    hosts = hosts_of(statuses)
    for name, status in statuses.items():
        for other, found in _map(status.detail.get("clocks")).items():
            numbers = [
                _number(_map(found).get(what))
                for what in ("round_trip_ms", "offset_ms", "uncertainty_ms")
            ]
            if hosts.get(other, hosts[name]) != hosts[name] and None not in numbers:
                round_trip_ms, offset_ms, uncertainty_ms = (n or 0.0 for n in numbers)
                links = _texts(_map(status.detail.get("net")).get("links"))
                out.append(
                    HostPair(
                        hosts[name],
                        hosts[other],
                        name,
                        other,
                        round_trip_ms,
                        offset_ms,
                        uncertainty_ms,
                        links,
                    )
                )
    return out


def lines_of(statuses: Mapping[str, NodeStatus]) -> list[Line]:
    """What nodes say that they write, the most bytes first, and what was lost of who is silent."""
    hosts = hosts_of(statuses)
    lost: dict[str, dict[str, int]] = {}
    for name, status in statuses.items():
        for key, count in _map(_map(status.detail.get("net")).get("lost")).items():
            lost.setdefault(key, {})[name] = int(_number(count) or 0)
    out: list[Line] = []
    for name, status in statuses.items():
        for key, rates in _map(_map(status.detail.get("net")).get("sent")).items():
            if isinstance(rates, (list, tuple)) and len(rates) == 2:
                rate_hz, bytes_s = (_number(rate) or 0.0 for rate in rates)
                line = Line(key, name, hosts[name], rate_hz, bytes_s, lost.get(key, {}))
                out.append(line)
    spoken = {line.key for line in out}
    out += [Line(key, NOBODY, NOBODY, 0.0, 0.0, lost[key]) for key in sorted(lost.keys() - spoken)]
    return sorted(out, key=lambda line: -line.bytes_s)


def _map(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, dict) else {}


def _number(value: Any) -> float | None:
    fine = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if fine else None


def _texts(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, (list, tuple)) else ()


def tables(
    robot: str, pairs: list[HostPair], lines: list[Line], bound_ms: float
) -> tuple[Table, ...]:
    """What a person sees: the pairs of hosts, and the keys.

    Args:
        robot: its name.
        pairs: of hosts.
        lines: of nodes and keys.
        bound_ms: clocks that differ by more are marked.
    """
    hosts = Table(header_style="bold", title=f"robot {robot}", title_justify="left")
    for column in ("from", "to", "round trip", "clock is ahead by", "link", "measured by"):
        hosts.add_column(column, overflow="fold")
    for pair in pairs:
        wrong = abs(pair.offset_ms) > bound_ms
        clock = f"{pair.offset_ms:+.2f} +- {pair.uncertainty_ms:.2f} ms"
        hosts.add_row(
            one_line(pair.seen_from),
            one_line(pair.host),
            one_line(f"{pair.round_trip_ms:.2f} ms", MAX_NUMBER),
            styled(one_line(clock, MAX_NUMBER), "bold red" if wrong else "white"),
            one_line(", ".join(pair.links)),
            one_line(f"{pair.by} of {pair.of}"),
        )
    keys = Table(header_style="bold")
    for column in ("key", "node", "host", "rate", "kbit/s", "lost on the way to"):
        keys.add_column(column, overflow="fold")
    for line in lines:
        lost = ", ".join(f"{node} {count}" for node, count in sorted(line.lost.items()))
        keys.add_row(
            one_line(line.key),
            one_line(line.node),
            one_line(line.host),
            one_line(f"{line.rate_hz:.1f} Hz", MAX_NUMBER),
            one_line(f"{line.bytes_s * 8e-3:,.1f}", MAX_NUMBER),
            styled(one_line(lost), "yellow"),
        )
    return hosts, keys
