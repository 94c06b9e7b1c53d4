"""python -m benchmarks codec."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from vla_zenoh.cli.options import options

BUDGET_S = 0.3
"""Time for one figure, at most `MAX_TURNS` turns."""
MIN_TURNS, MAX_TURNS = 5, 2000


@options
def codec(output: ResultOptions) -> None:
    """Measure encoding and decoding, ours and ROS 2's, in microseconds.

    For ROS 2 also with cyclonedds and pycdr2, if they are installed.
    """
    from rich.table import Table

    from benchmarks.codec.codecs import cases
    from benchmarks.codec.other_cdr import MODULES

    rows: list[dict[str, Any]] = []
    with output.open() as file:
        for case in cases():
            us = {"encode": _median_us(case.encode), "decode": _median_us(case.decode)}
            for library, (encode, decode) in case.others.items():
                us |= {
                    f"{library} encode": _median_us(encode),
                    f"{library} decode": _median_us(decode),
                }
            rows.append({"name": case.name, "bytes": case.payload_bytes, "us": us})
        write_json(file, rows)
    table = Table(title="microseconds (or ms) to encode / decode, median")
    table.add_column("what")
    table.add_column("bytes", justify="right", no_wrap=True)
    columns = ("ours", *MODULES)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(row["name"], str(row["bytes"]), *(_pair(row["us"], c) for c in columns))
    output.show(rows, table)


def _pair(us: dict[str, float], who: str) -> str:
    before = "" if who == "ours" else f"{who} "
    if f"{before}encode" not in us:
        return ""
    return f"{_shown(us[f'{before}encode'])} / {_shown(us[f'{before}decode'])}"


def _shown(us: float) -> str:
    return f"{us:.1f}" if us < 1000 else f"{us / 1000:.1f} ms"


def _median_us(function: Callable[[], Any]) -> float:
    taken_ns: list[int] = []
    give_up = time.perf_counter() + BUDGET_S
    while len(taken_ns) < MIN_TURNS or (
        len(taken_ns) < MAX_TURNS and time.perf_counter() < give_up
    ):
        began_ns = time.perf_counter_ns()
        function()
        taken_ns.append(time.perf_counter_ns() - began_ns)
    return statistics.median(taken_ns) / 1e3
