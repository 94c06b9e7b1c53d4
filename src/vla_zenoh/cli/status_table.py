"""Table of ``vla-zenoh status``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.live import Live
from rich.padding import Padding
from rich.text import Text

from vla_zenoh.cli.node_rows import (
    MODE_WORDS,
    STALE_S,
    NodeRow,
    Statuses,
    acting_limits,
    hosts_down,
    mode_of,
    node_rows,
)
from vla_zenoh.cli.output import ENDLESS, console, new_table, styled
from vla_zenoh.client.client import DROPPED_HINT
from vla_zenoh.sanitize import one_line, printable
from vla_zenoh.types import Event, Header, NodeStatus

if TYPE_CHECKING:
    from vla_zenoh.client.client import Client

REFRESH_HZ = 4.0
MAX_EVENTS = 8
MAX_LINES, MAX_LINE = 12, 60
"""Lines of one cell, and characters of each."""
MAX_WORDS = 400
"""Characters of one sentence."""
NARROW = 132
"""On a terminal of fewer columns a node has lines of its own in place of a row."""
NARROW_LINES = 4
"""Of one message there."""
STYLES = {
    "active": "bold green",
    "inactive": "cyan",
    **dict.fromkeys(("inferring", "running", "routing", "ok"), "green"),
    **dict.fromkeys(("holding", "waiting", "braking", "silent", "stalled", "unheeded"), "yellow"),
    **dict.fromkeys(("starting", "degraded"), "yellow"),
    **dict.fromkeys(("stopped", "latched", "fault", "dead", "missing", "crashed"), "bold red"),
    "unreadable": "bold red",
}
LEVELS = {"warning": "yellow", "error": "red"}


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
        unreadable=robot.unreadable,
        width=console().width,
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
    unreadable: Mapping[str, str] = MappingProxyType({}),
    width: int = ENDLESS,
) -> Group:
    """The table of nodes and the events. Warnings come first: no table pushes them off the screen.

    `left_out` counts statuses of unknown nodes that were not kept; `expected`, `alive` and
    `unreadable` are those of `node_rows`. On a terminal whose `width` is below `NARROW` there is no
    table: it would wrap each message into dozens of lines.
    """
    mode, sentence, style = MODE_WORDS[mode_of(nodes)]
    title = Text.assemble((mode, style), printable(f" robot {robot}: {sentence}"))
    columns = ("node", "state", "age", "rate", "rejected", "message")
    found = node_rows(nodes, expected or {}, alive, unreadable)
    rows = [_cells(row, mode) for row in found]
    table: RenderableType
    if width < NARROW:
        table = Group(title, *(part for cells in rows for part in _paragraphs(cells, width)))
    else:
        table = new_table(*columns, title=title, title_style="")
        for cells in rows:
            table.add_row(*cells)
    above = [_line(*each) for each in _warnings(nodes, insecure=insecure, left_out=left_out)]
    below = [_line(f"limit acting now: {limit}", "yellow") for limit in acting_limits(nodes)]
    for host, missing in hosts_down(nodes, expected or {}, alive).items():
        text = f"host {host} does not run ({', '.join(missing)}): `vla-zenoh up` there starts it"
        below.append(_line(text, "bold yellow"))
    for name, (found, _, _) in nodes.items():
        stages = ", ".join(
            f"{stage.replace('_', ' ')} {values[0]:.1f}/{values[1]:.1f}"
            for stage, values in found.latency_ms.items()
        )
        below += [_line(f"{one_line(name)}, ms p50/p95: {stages}", "dim")] if stages else []
    return Group(*above, table, *below, *(_event(*each) for each in events[-MAX_EVENTS:]))


def _paragraphs(cells: Sequence[str | Text], width: int) -> Iterator[RenderableType]:
    """The row of a node as its name, state and age, and below them what else it has."""
    name, state, age, *others = cells
    yield Text.assemble(printable(str(name)), "  ", state, "  ", age)
    for words in others:
        if words:
            text = one_line("; ".join(str(words).splitlines()), NARROW_LINES * (width - 4))
            yield Padding(Text(text), (0, 0, 0, 2))


def _line(text: str, style: str) -> Text:
    return styled(one_line(text, MAX_WORDS), style)


def _fields(value: object) -> Mapping[str, Any]:
    """A map in the detail of a status; empty if a node put something else there."""
    return value if isinstance(value, Mapping) else {}


def _warnings(nodes: Statuses, *, insecure: bool, left_out: int) -> Iterator[tuple[str, str]]:
    """Sentences and their styles: open routers, bad certificates, what of ROS 2 does not work,
    unknown nodes."""
    details = {name: found.detail for name, (found, _, _) in nodes.items()}
    routers = {
        n: one.get("listen") for n, one in details.items() if one.get("security") == "insecure"
    }
    if insecure or routers:
        where = "; ".join(
            f"{name} listens on {', '.join(map(str, listen))}"
            for name, listen in routers.items()
            if isinstance(listen, (list, tuple))
        )
        more = f" ({where})" if where else ""
        yield f"insecure: anyone on the network can command this robot{more}", "bold red"
    for name, detail in details.items():
        wrong = _fields(detail.get("certificates")).get("wrong")
        if isinstance(wrong, (list, tuple)) and wrong:
            host = nodes[name][0].host
            yield f"certificates of {name} on {host}: {'; '.join(map(str, wrong))}", "bold yellow"
        for why in _fields(detail.get("ros2_faults")).values():
            yield f"{name}: {why}", "bold yellow"
    without: dict[str, list[str]] = {}
    for name, detail in details.items():
        why = _fields(_fields(detail.get("net")).get("shared_memory")).get("off")
        if isinstance(why, str):
            without.setdefault(why, []).append(name)
    for why, names in without.items():
        if why:
            yield f"no shared memory in {', '.join(names)}: {why}", "dim"
    if left_out:
        yield f"{left_out} {DROPPED_HINT}", "yellow"


def _cells(row: NodeRow, mode: str) -> tuple[str | Text, ...]:
    """The cells of a node; a node that moves the robot has the mode as prefix."""
    found, age_s = row.status, row.age_s
    state = one_line(row.state, MAX_LINE)
    style = STYLES.get(state, "white")
    if row.name == "command" and row.alive:
        state = f"{mode} {state}"
    late = age_s is not None and age_s > STALE_S
    rates = found.rates_hz.items() if found is not None and row.alive else ()
    counters = sorted(found.counters.items()) if found is not None else ()
    refused = [
        f"{name.removeprefix('refused.')} {count}"
        for name, count in counters
        if name.startswith("refused.")
    ]
    return (
        one_line(row.name),
        styled(state, style),
        styled("" if age_s is None else f"{age_s:.1f} s", "red" if late else "white"),
        _cell([f"{key} {value:.0f} Hz" for key, value in rates]),
        _cell(refused),
        one_line(row.why, MAX_WORDS) if row.why or found is None else _message(row, found, mode),
    )


def _cell(lines: list[str], most: int = MAX_LINE) -> str:
    more = [f"and {len(lines) - MAX_LINES} more"] if len(lines) > MAX_LINES else []
    return "\n".join([*(one_line(line, most) for line in lines[:MAX_LINES]), *more])


def _message(row: NodeRow, found: NodeStatus, mode: str) -> str:
    detail = found.detail
    short = [str(why) for why in _fields(_fields(detail.get("net")).get("short")).values()]
    if row.name == "command":
        rate_hz, speed = detail.get("rate_hz"), detail.get("speed_percent")
        rate = f"{rate_hz:g}" if isinstance(rate_hz, (int, float)) else "?"
        slowed = isinstance(speed, (int, float)) and speed < 100
        task = (
            f"prompt {detail.get('prompt', '')!r}, worker {detail.get('worker', '')}, {rate} Hz, "
            f"{detail.get('accepted_chunks', 0)} chunks executed"
            f"{f', speed {speed:g} %' if slowed else ''}"
        )
        return _cell([*short, str(detail.get("why", "")), task], MAX_WORDS)
    if short:
        return _cell(short, MAX_WORDS)
    if wrong := complaints(detail):
        return _cell(wrong, MAX_WORDS)
    told = (detail.get(name) for name in ("busy", "slow", "renderer", "gripper"))
    text = str(next(filter(None, told), ""))
    if not text and "obeyed" in detail:
        return (f"{mode}: in control" if detail["obeyed"] else "shadow mode") + _gpus(detail)
    certificates = _fields(detail.get("certificates"))
    days, unknown = certificates.get("days"), certificates.get("unknown")
    if not text and isinstance(days, (int, float)):
        text = f"certificates last {days:g} days"
    if not text and (seen := _fields(detail.get("middleware"))):
        text = f"robot's ROS 2: {', '.join(map(str, seen))}"
    return one_line(text or (unknown if isinstance(unknown, str) else ""), MAX_WORDS)


def _gpus(detail: Mapping[str, Any]) -> str:
    """Load and memory of the GPUs of a worker's host; older workers do not say."""
    if not isinstance(found := detail.get("gpus"), list):
        return ""
    out = ["no GPU"] if not found else []
    for gpu in map(_fields, found):
        load, *memory = (gpu.get(name) for name in ("load_percent", "used_bytes", "total_bytes"))
        gib = (f"{size / 2**30:.1f}" if isinstance(size, int) else "?" for size in memory)
        out.append(f"GPU {'?' if load is None else load} %, {' of '.join(gib)} GiB")
    return "".join(f", {text}" for text in out)


def complaints(detail: Mapping[str, Any]) -> list[str]:
    """What a node says is wrong with it, by the `detail` of its status."""
    own = (detail.get(name) for name in ("complaint", "fault"))
    return [*_bad_cameras(_fields(detail.get("cameras"))), *map(str, filter(None, own))]


def _bad_cameras(cameras: Mapping[str, Any]) -> list[str]:
    """What is wrong with each camera of a node."""
    out: list[str] = []
    for name, camera in cameras.items():
        bad, why = _fields(camera).get("bad"), _fields(camera).get("why")
        if isinstance(bad, Mapping):
            out.append(f"camera {name!r} {bad.get('why', '')}")
        elif isinstance(why, str) and why:
            out.append(f"camera {name!r}: {why}")
    return out


def _event(node: str, header: Header, event: Event) -> Text:
    when = time.strftime("%H:%M:%S", time.localtime(header.stamp_wall_ns / 1e9))
    again = f" (x{event.count})" if event.count > 1 else ""
    why = f": {one_line(event.why, 160)}" if event.why else ""
    text = f"{one_line(event.what)}{again}{why}"
    return styled(f"{when} {one_line(node):>16} {text}", LEVELS.get(event.level, "white"))
