"""vla-zenoh status."""

from __future__ import annotations

import dataclasses
import time
from typing import Annotated

import typer
from rich.console import Group
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    JsonOption,
    ProfileOption,
    client,
)
from vla_zenoh.cli.output import console, fail, print_json, printable
from vla_zenoh.nodes.client import Client
from vla_zenoh.types import Event, Header, NodeStatus

LISTEN_S = 1.2
REFRESH_HZ = 4.0
MAX_EVENTS = 8
STALE_S = 1.5
STYLES = {
    "active": "bold green",
    "inferring": "green",
    "running": "green",
    "routing": "green",
    "ok": "green",
    "inactive": "cyan",
    "holding": "yellow",
    "waiting": "yellow",
    "braking": "yellow",
    "stopped": "bold red",
    "fault": "bold red",
    "dead": "bold red",
}


def status(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    as_json: JsonOption = False,
    once: Annotated[bool, typer.Option("--once", help="Print the table once and end.")] = False,
) -> None:
    """Show every node: state, rates, ages, latencies, counters, and what happened last."""
    with client(profile, connect) as robot:
        if as_json or once or not console().is_terminal:
            time.sleep(LISTEN_S)
            if as_json:
                print_json(_plain(robot))
            else:
                console().print(_picture(robot, robot.take_events()))
            if not robot.statuses:
                fail(f"no node of robot {robot.keys.robot!r} says anything")
            return
        _live(robot)


def _live(robot: Client) -> None:
    events: list[tuple[str, Header, Event]] = []
    with Live(console=console(), auto_refresh=False, screen=False) as live:
        while True:
            events = [*events, *robot.take_events()][-MAX_EVENTS:]
            live.update(_picture(robot, events), refresh=True)
            time.sleep(1.0 / REFRESH_HZ)


def _plain(robot: Client) -> dict[str, object]:
    return {
        name: {**dataclasses.asdict(found), "age_s": round(age_s, 3), "alive": alive}
        for name, (found, age_s, alive) in robot.snapshot().items()
    }


def _picture(robot: Client, events: list[tuple[str, Header, Event]]) -> Group:
    table = Table(header_style="bold", title=f"robot {robot.keys.robot}", title_justify="left")
    for column in ("node", "state", "age", "rate", "refused", "what it says"):
        table.add_column(column, overflow="fold")
    for name, (found, age_s, alive) in robot.snapshot().items():
        state = found.state if alive else "dead"
        table.add_row(
            name,
            f"[{STYLES.get(state, 'white')}]{escape(state)}[/]",
            f"[{'red' if age_s > STALE_S else 'white'}]{age_s:.1f} s[/]",
            "\n".join(f"{key} {value:.0f} Hz" for key, value in found.rates_hz.items()),
            _refused(found),
            escape(_word(found)),
        )
    lines = [_latency(name, found) for name, (found, _, _) in robot.snapshot().items()]
    news = [_event(*happened) for happened in events[-MAX_EVENTS:]]
    return Group(table, *_open_to_all(robot), *(line for line in lines if line), *news)


def _open_to_all(robot: Client) -> list[Text]:
    """In red: that strangers may command the robot, by the profile's word or a router's."""
    said = {
        name: found.detail.get("listen")
        for name, (found, _, _) in robot.snapshot().items()
        if found.detail.get("security") == "insecure"
    }
    if not said and not robot.profile.session.insecure:
        return []
    where = "; ".join(
        f"{name} listens on {', '.join(map(str, listen))}"
        for name, listen in said.items()
        if isinstance(listen, (list, tuple))
    )
    words = "insecure: everybody on the network can command this robot"
    return [Text(printable(f"{words} ({where})" if where else words), style="bold red")]


def _latency(name: str, found: NodeStatus) -> Text | None:
    if not found.latency_ms:
        return None
    stages = ", ".join(
        f"{stage.replace('_', ' ')} {values[0]:.1f}/{values[1]:.1f}"
        for stage, values in found.latency_ms.items()
    )
    return Text(f"{name}, ms p50/p95: {stages}", style="dim")


def _refused(found: NodeStatus) -> str:
    refused = {
        name.removeprefix("refused."): count
        for name, count in found.counters.items()
        if name.startswith("refused.")
    }
    return "\n".join(f"{escape(reason)} {count}" for reason, count in sorted(refused.items()))


def _word(found: NodeStatus) -> str:
    detail = found.detail
    if found.node == "command":
        return (
            f"{detail.get('why', '')}\nprompt {detail.get('prompt', '')!r}, worker "
            f"{detail.get('worker', '')}, {detail.get('rate_hz', 0):g} Hz, "
            f"{detail.get('accepted_chunks', 0)} chunks carried out"
        )
    word = str(detail.get("complaint") or detail.get("fault") or detail.get("renderer") or "")
    if not word and "obeyed" in detail:
        return "obeyed" if detail["obeyed"] else "in the shadow"
    return word


def _event(node: str, header: Header, event: Event) -> Text:
    when = time.strftime("%H:%M:%S", time.localtime(header.stamp_wall_ns / 1e9))
    style = {"info": "white", "warning": "yellow", "error": "red"}.get(event.level, "white")
    again = f" (x{event.count})" if event.count > 1 else ""
    return Text(f"{when} {node:>16} {event.what}{again}: {event.why[:160]}", style=style)
