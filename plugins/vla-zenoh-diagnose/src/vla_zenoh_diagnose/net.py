"""vla-zenoh net: round trips and clocks between hosts, and what each key costs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from rich.table import Table

from vla_zenoh.bus.clock import Clock, ClockSync
from vla_zenoh.cli.options import MAX_SECONDS, JsonOption, options
from vla_zenoh.cli.output import console, fail, new_table, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import NodeStatus

HERE = "this computer"
NOBODY = "-"
POLL_S = 0.05
SHOWN_OF_BOOT = 8
"""Characters of a boot id."""
MAX_NUMBER = 40
"""Characters: a status may hold 1e308."""


@dataclass(frozen=True, slots=True)
class HostPair:
    """Round trip and clock offset from one host to another.

    Args:
        offset_ms: the other clock minus the measuring one.
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
    """Traffic of one node on one key.

    Args:
        node: publisher; "-" where there is none now and records were lost before.
        bytes_s: bytes per second, counted once for all subscribers.
        lost: subscriber -> records that did not reach it.
    """

    key: str
    node: str
    host: str
    rate_hz: float
    bytes_s: float
    lost: dict[str, int]


@options
def net(
    target: RobotTarget,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=1.0, max=MAX_SECONDS, help="How long to listen.")
    ] = 3.0,
    as_json: JsonOption = False,
) -> None:
    """Show link, round trip and clock offset between hosts, and the bandwidth of each key."""
    with target.client() as client, progress(f"listening for {seconds:g} s"):
        bound_s = client.profile.timing.max_clock_offset_s
        clocks = ClockSync(client.session, client.keys, Clock(), HERE, bound_s)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            for node in tuple(client.alive):
                clocks.track(node)
            clocks.poll()
            time.sleep(POLL_S)
        statuses = {name: found for name, (found, _, alive) in client.snapshot().items() if alive}
        own_links = tuple(sorted(str(link.dst) for link in client.session.info.links()))
        pairs = pairs_of(statuses, _own(clocks, statuses, own_links))
        lines = lines_of(statuses)
        why = "" if statuses else target.no_node(client, "net")
    bound_ms = bound_s * 1e3
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
    hosts = hosts_of(statuses)
    return [
        HostPair(
            HERE,
            hosts[node],
            "net",
            node,
            round(at.round_trip_s * 1e3, 3),
            round(at.offset_s * 1e3, 3),
            round(at.uncertainty_s * 1e3, 3),
            links,
        )
        for node, at in clocks.offsets().items()
        if node in statuses
    ]


def hosts_of(statuses: Mapping[str, NodeStatus]) -> dict[str, str]:
    """Node -> its host, with a part of the boot id where several computers have the same name.

    Computers of a laboratory are often copies of one, host name included.
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
    """The most certain measurement of each pair of hosts, of `own` and of the statuses."""
    best: dict[tuple[str, str], HostPair] = {}
    for pair in [*own, *_measured(statuses)]:
        hosts = (pair.seen_from, pair.host)
        if hosts not in best or pair.uncertainty_ms < best[hosts].uncertainty_ms:
            best[hosts] = pair
    return [best[hosts] for hosts in sorted(best)]


def _measured(statuses: Mapping[str, NodeStatus]) -> list[HostPair]:
    """Measurements of nodes, of nodes on other hosts."""
    out: list[HostPair] = []
    hosts = hosts_of(statuses)
    for name, status in statuses.items():
        for other, found in _map(status.detail.get("clocks")).items():
            names = ("round_trip_ms", "offset_ms", "uncertainty_ms")
            found_ms = [_number(_map(found).get(what)) for what in names]
            known_ms = [each for each in found_ms if each is not None]
            if hosts.get(other, hosts[name]) != hosts[name] and len(known_ms) == len(names):
                links = _map(status.detail.get("net")).get("links")
                texts = tuple(map(str, links)) if isinstance(links, (list, tuple)) else ()
                trip_ms, ahead_ms, unsure_ms = known_ms
                pair = (hosts[name], hosts[other], name, other)
                out.append(HostPair(*pair, trip_ms, ahead_ms, unsure_ms, texts))
    return out


def lines_of(statuses: Mapping[str, NodeStatus]) -> list[Line]:
    """Traffic of each node and key, most bytes first, and losses of publishers now silent."""
    hosts = hosts_of(statuses)
    lost: dict[str, dict[str, int]] = {}
    for name, status in statuses.items():
        for key, count in _map(_map(status.detail.get("net")).get("lost")).items():
            lost.setdefault(key, {})[name] = int(_number(count) or 0)
    out: list[Line] = []
    for name, status in statuses.items():
        for key, rates in _map(_map(status.detail.get("net")).get("sent")).items():
            if isinstance(rates, (list, tuple)) and len(rates) == 3:
                rate_hz, bytes_s, _ = (_number(rate) or 0.0 for rate in rates)
                line = Line(key, name, hosts[name], rate_hz, bytes_s, lost.get(key, {}))
                out.append(line)
    published = {line.key for line in out}
    silent = sorted(lost.keys() - published)
    out += [Line(key, NOBODY, NOBODY, 0.0, 0.0, lost[key]) for key in silent]
    return sorted(out, key=lambda line: -line.bytes_s)


def _map(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, dict) else {}


def _number(value: Any) -> float | None:
    valid = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if valid else None


def tables(
    robot: str, pairs: list[HostPair], lines: list[Line], bound_ms: float
) -> tuple[Table, ...]:
    """A table of the pairs of hosts and one of the keys.

    Args:
        bound_ms: a clock offset that is larger than this and its uncertainty is marked.
    """
    columns = ("from", "to", "round trip", "clock ahead by", "link", "measured by")
    hosts = new_table(*columns, title=f"robot {robot}")
    for pair in pairs:
        wrong = abs(pair.offset_ms) > max(bound_ms, pair.uncertainty_ms)
        clock = f"{pair.offset_ms:+.2f} +- {pair.uncertainty_ms:.2f} ms"
        hosts.add_row(
            one_line(pair.seen_from),
            one_line(pair.host),
            one_line(f"{pair.round_trip_ms:.2f} ms", MAX_NUMBER),
            styled(one_line(clock, MAX_NUMBER), "bold red" if wrong else "white"),
            one_line(", ".join(pair.links)),
            one_line(f"{pair.by} of {pair.of}"),
        )
    keys = new_table("key", "node", "host", "rate", "kbit/s", "lost by")
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
