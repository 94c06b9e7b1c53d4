"""vla-zenoh status: state, rates, counters and events of all nodes.

Shows what nodes publish in their `NodeStatus`, never a stream: a value to be shown belongs into the
``detail`` of a node's status.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Annotated

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from vla_zenoh.bus.client import DROPPED_HINT, Client
from vla_zenoh.cli.options import JsonOption, options
from vla_zenoh.cli.output import console, fail, new_table, print_json, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, Header, NodeStatus

Statuses = Mapping[str, tuple[NodeStatus, float, bool]]
"""Node -> (its last status, seconds since it came, alive)."""
LISTEN_S = 1.2
REFRESH_HZ = 4.0
MAX_EVENTS = 8
MAX_LINES, MAX_LINE = 12, 60
"""Lines of one cell, and characters of each."""
MAX_WORDS = 400
"""Characters of one sentence."""
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
    "silent": "yellow",
    "stalled": "yellow",
    "unheeded": "yellow",
    "stopped": "bold red",
    "fault": "bold red",
    "dead": "bold red",
}


@options
def status(
    target: RobotTarget,
    as_json: JsonOption = False,
    once: Annotated[bool, typer.Option("--once", help="Print the table once and exit.")] = False,
) -> None:
    """Show every node: state, age, rates, latencies, counters, and the last events."""
    with target.client() as client:
        if as_json or once or not console().is_terminal:
            time.sleep(LISTEN_S)
            if as_json:
                print_json(_mapping(client))
            else:
                console().print(_now(client, client.pop_events()))
            if not client.snapshot():
                fail(target.no_node(client, "status"))
            return
        _live(client)


def _live(robot: Client) -> None:
    events: list[tuple[str, Header, Event]] = []
    with Live(console=console(), auto_refresh=False, screen=False) as live:
        while True:
            events = [*events, *robot.pop_events()][-MAX_EVENTS:]
            live.update(_now(robot, events), refresh=True)
            time.sleep(1.0 / REFRESH_HZ)


def _mapping(robot: Client) -> dict[str, object]:
    return {
        name: {**dataclasses.asdict(found), "age_s": round(age_s, 3), "alive": alive}
        for name, (found, age_s, alive) in robot.snapshot().items()
    }


def _now(robot: Client, events: Sequence[tuple[str, Header, Event]]) -> Group:
    return render(
        robot.keys.robot,
        robot.snapshot(),
        events,
        insecure=robot.profile.session.insecure,
        left_out=robot.dropped,
    )


def render(
    robot: str,
    nodes: Statuses,
    events: Sequence[tuple[str, Header, Event]],
    *,
    insecure: bool = False,
    left_out: int = 0,
) -> Group:
    """The table of nodes and the events. Warnings come first: no table pushes them off the screen.

    Args:
        robot: its name.
        nodes: the status of each, by the node name in its key.
        events: oldest first.
        insecure: the profile lets anyone command the robot.
        left_out: statuses of unknown nodes that were not kept.
    """
    columns = ("node", "state", "age", "rate", "rejected", "message")
    table = new_table(*columns, title=f"robot {robot}")
    for name, (found, age_s, alive) in nodes.items():
        state = found.state if alive else "dead"
        table.add_row(
            one_line(name),
            styled(one_line(state, MAX_LINE), STYLES.get(state, "white")),
            styled(f"{age_s:.1f} s", "red" if age_s > STALE_S else "white"),
            _lines(_rates(found)),
            _lines(_rejected(found)),
            _message(name, found),
        )
    lines = [_latency(name, found) for name, (found, _, _) in nodes.items()]
    happened = [_event(*each) for each in events[-MAX_EVENTS:]]
    warnings = [*_insecure(nodes, insecure=insecure), *_bad_certificates(nodes)]
    if left_out:
        warnings.append(styled(f"{left_out} {DROPPED_HINT}", "yellow"))
    return Group(*warnings, table, *(line for line in lines if line), *happened)


def _insecure(nodes: Statuses, *, insecure: bool) -> list[Text]:
    """Warning in red that anyone may command the robot, by the profile or a router's status."""
    open_routers = {
        name: found.detail.get("listen")
        for name, (found, _, _) in nodes.items()
        if found.detail.get("security") == "insecure"
    }
    if not open_routers and not insecure:
        return []
    where = "; ".join(
        f"{name} listens on {', '.join(map(str, listen))}"
        for name, listen in open_routers.items()
        if isinstance(listen, (list, tuple))
    )
    words = "insecure: anyone on the network can command this robot"
    more = f" ({one_line(where, MAX_WORDS)})" if where else ""
    return [styled(f"{words}{more}", "bold red")]


def _bad_certificates(nodes: Statuses) -> list[Text]:
    """Warnings of routers about certificates that are invalid, or soon will be."""
    out: list[Text] = []
    for name, (found, _, _) in nodes.items():
        certificates = found.detail.get("certificates")
        wrong = certificates.get("wrong") if isinstance(certificates, dict) else None
        if isinstance(wrong, (list, tuple)) and wrong:
            words = f"certificates of {name} on {found.host}: {'; '.join(map(str, wrong))}"
            out.append(styled(one_line(words, MAX_WORDS), "bold yellow"))
    return out


def _days_left(certificates: object) -> str:
    """How long a router's certificates last."""
    if not isinstance(certificates, dict):
        return ""
    days, unknown = certificates.get("days"), certificates.get("unknown")
    if isinstance(days, (int, float)):
        return f"certificates last {days:g} days"
    return one_line(unknown, MAX_WORDS) if isinstance(unknown, str) else ""


def _latency(name: str, found: NodeStatus) -> Text | None:
    if not found.latency_ms:
        return None
    stages = ", ".join(
        f"{stage.replace('_', ' ')} {values[0]:.1f}/{values[1]:.1f}"
        for stage, values in found.latency_ms.items()
    )
    return styled(f"{one_line(name)}, ms p50/p95: {one_line(stages, MAX_WORDS)}", "dim")


def _lines(lines: list[str]) -> str:
    more = [f"and {len(lines) - MAX_LINES} more"] if len(lines) > MAX_LINES else []
    return "\n".join([*lines[:MAX_LINES], *more])


def _rates(found: NodeStatus) -> list[str]:
    return [one_line(f"{key} {value:.0f} Hz", MAX_LINE) for key, value in found.rates_hz.items()]


def _rejected(found: NodeStatus) -> list[str]:
    counts = {
        name.removeprefix("refused."): count
        for name, count in found.counters.items()
        if name.startswith("refused.")
    }
    return [one_line(f"{reason} {count}", MAX_LINE) for reason, count in sorted(counts.items())]


def _message(name: str, found: NodeStatus) -> str:
    detail = found.detail
    if name == "command":
        rate_hz = detail.get("rate_hz")
        rate = f"{rate_hz:g}" if isinstance(rate_hz, (int, float)) else "?"
        speed = detail.get("speed_percent")
        slowed = isinstance(speed, (int, float)) and speed < 100
        task = (
            f"prompt {detail.get('prompt', '')!r}, worker {detail.get('worker', '')}, {rate} Hz, "
            f"{detail.get('accepted_chunks', 0)} chunks carried out"
            f"{f', speed {speed:g} %' if slowed else ''}"
        )
        return f"{one_line(detail.get('why', ''), MAX_WORDS)}\n{one_line(task, MAX_WORDS)}"
    if bad := _bad_cameras(detail.get("cameras")):
        return _lines([one_line(each, MAX_WORDS) for each in bad])
    text = str(detail.get("complaint") or detail.get("fault") or detail.get("renderer") or "")
    if not text and "obeyed" in detail:
        return "moves the arm" if detail["obeyed"] else "shadow mode"
    return one_line(text or _days_left(detail.get("certificates")), MAX_WORDS)


def _bad_cameras(cameras: object) -> list[str]:
    """What is wrong with each camera of a node."""
    out: list[str] = []
    for name, fields in cameras.items() if isinstance(cameras, Mapping) else ():
        bad = fields.get("bad") if isinstance(fields, Mapping) else None
        if isinstance(bad, Mapping):
            out.append(f"camera {name!r} {bad.get('why', '')}")
    return out


def _event(node: str, header: Header, event: Event) -> Text:
    when = time.strftime("%H:%M:%S", time.localtime(header.stamp_wall_ns / 1e9))
    style = {"info": "white", "warning": "yellow", "error": "red"}.get(event.level, "white")
    again = f" (x{event.count})" if event.count > 1 else ""
    text = f"{one_line(event.what)}{again}: {one_line(event.why, 160)}"
    return styled(f"{when} {one_line(node):>16} {text}", style)
