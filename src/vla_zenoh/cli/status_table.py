"""Table of ``vla-zenoh status``."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Group
from rich.live import Live
from rich.text import Text

from vla_zenoh.bus.client import DROPPED_HINT
from vla_zenoh.cli.node_rows import (
    MODE_WORDS,
    NodeRow,
    Statuses,
    acting_limits,
    hosts_down,
    mode_of,
    node_rows,
)
from vla_zenoh.cli.output import console, new_table, styled
from vla_zenoh.sanitize import one_line, printable
from vla_zenoh.types import Event, Header, NodeStatus

if TYPE_CHECKING:
    from vla_zenoh.bus.client import Client

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
    "missing": "bold red",
    "crashed": "bold red",
    "starting": "yellow",
    "degraded": "yellow",
}


def show_live(robot: Client) -> None:
    events: list[tuple[str, Header, Event]] = []
    with Live(console=console(), auto_refresh=False, screen=False) as live:
        while True:
            events = [*events, *robot.pop_events()][-MAX_EVENTS:]
            live.update(_now(robot, events), refresh=True)
            time.sleep(1.0 / REFRESH_HZ)


def show_once(robot: Client) -> None:
    """Print the table."""
    console().print(_now(robot, robot.pop_events()))


def _now(robot: Client, events: Sequence[tuple[str, Header, Event]]) -> Group:
    return render(
        robot.keys.robot,
        robot.snapshot(),
        events,
        insecure=robot.profile.session.insecure,
        left_out=robot.dropped,
        expected=robot.expected,
        alive=robot.alive,
    )


def render(
    robot: str,
    nodes: Statuses,
    events: Sequence[tuple[str, Header, Event]],
    *,
    insecure: bool = False,
    left_out: int = 0,
    expected: Mapping[str, str] | None = None,
    alive: frozenset[str] = frozenset(),
) -> Group:
    """The table of nodes and the events. Warnings come first: no table pushes them off the screen.

    Args:
        robot: its name.
        nodes: the status of each, by the node name in its key.
        events: oldest first.
        insecure: the profile lets anyone command the robot.
        left_out: statuses of unknown nodes that were not kept.
        expected: nodes of the profile, each with its host.
        alive: nodes that have a liveliness token.
    """
    word, sentence, style = MODE_WORDS[mode_of(nodes)]
    columns = ("node", "state", "age", "rate", "rejected", "message")
    title = Text.assemble((word, style), printable(f" robot {robot}: {sentence}"))
    table = new_table(*columns, title=title, title_style="")
    for row in node_rows(nodes, expected or {}, alive):
        table.add_row(*_cells(row, word))
    lines = [_latency(name, found) for name, (found, _, _) in nodes.items()]
    happened = [_event(*each) for each in events[-MAX_EVENTS:]]
    warnings = [*_insecure(nodes, insecure=insecure), *_bad_certificates(nodes)]
    if left_out:
        warnings.append(styled(f"{left_out} {DROPPED_HINT}", "yellow"))
    below = [
        styled(one_line(f"limit acting now: {limit}", MAX_WORDS), "yellow")
        for limit in acting_limits(nodes)
    ]
    for host, missing in hosts_down(nodes, expected or {}, alive).items():
        text = f"host {host} does not run ({', '.join(missing)}): `vla-zenoh up` there starts it"
        below.append(styled(one_line(text, MAX_WORDS), "bold yellow"))
    return Group(*warnings, table, *below, *(line for line in lines if line), *happened)


def _cells(row: NodeRow, mode: str) -> tuple[str | Text, ...]:
    """The cells of a node; what moves, or says that it does, has the mode in front."""
    found, age_s = row.status, row.age_s
    state = one_line(row.state, MAX_LINE)
    style = STYLES.get(state, "white")
    if row.name == "command" and row.alive:
        state = f"{mode} {state}"
    age = "" if age_s is None else f"{age_s:.1f} s"
    late = age_s is not None and age_s > STALE_S
    return (
        one_line(row.name),
        styled(state, style),
        styled(age, "red" if late else "white"),
        _lines(_rates(found)) if found is not None and row.alive else "",
        _lines(_rejected(found)) if found is not None else "",
        one_line(row.why, MAX_WORDS) if row.why or found is None else _message(row, found, mode),
    )


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


def _message(row: NodeRow, found: NodeStatus, mode: str) -> str:
    detail = found.detail
    if row.name == "command":
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
        return f"{mode}: in control" if detail["obeyed"] else "shadow mode"
    return one_line(text or _days_left(detail.get("certificates")), MAX_WORDS)


def _bad_cameras(cameras: object) -> list[str]:
    """What is wrong with each camera of a node."""
    out: list[str] = []
    for name, fields in cameras.items() if isinstance(cameras, Mapping) else ():
        bad = fields.get("bad") if isinstance(fields, Mapping) else None
        why = fields.get("why") if isinstance(fields, Mapping) else None
        if isinstance(bad, Mapping):
            out.append(f"camera {name!r} {bad.get('why', '')}")
        elif isinstance(why, str) and why:
            out.append(f"camera {name!r}: {why}")
    return out


def _event(node: str, header: Header, event: Event) -> Text:
    when = time.strftime("%H:%M:%S", time.localtime(header.stamp_wall_ns / 1e9))
    style = {"info": "white", "warning": "yellow", "error": "red"}.get(event.level, "white")
    again = f" (x{event.count})" if event.count > 1 else ""
    text = f"{one_line(event.what)}{again}: {one_line(event.why, 160)}"
    return styled(f"{when} {one_line(node):>16} {text}", style)
