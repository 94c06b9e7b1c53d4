"""vla-zenoh bench command: time per tick of the command node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer
from rich.progress import track
from rich.table import Table

from vla_zenoh.cli.options import DEFAULT_PROFILE, effective_profile, options
from vla_zenoh.cli.output import errors, new_table
from vla_zenoh.lab.cli.options import SimulatedProfileOption, number_list
from vla_zenoh_benchmarks.result_file import ResultOptions, kept_rows

SHARES = ("p50", "p95", "p99", "max")


@options
def command(
    result: ResultOptions,
    rates: Annotated[
        str, typer.Option("--rates", help="Ticks per second, separated by commas.")
    ] = "250,500,1000",
    seconds: Annotated[
        float, typer.Option("--seconds", min=8, max=600, help="Duration at each rate.")
    ] = 10.0,
    busy: Annotated[
        int, typer.Option("--busy", min=0, max=64, help="Busy processes beside it.")
    ] = 0,
    profile: SimulatedProfileOption = DEFAULT_PROFILE,
) -> None:
    """Measure the time per tick of the command node while the simulated arm moves.

    A loop that only sleeps runs beside it, at the same rate and priority: what that misses is the
    computer's. The real nodes are started once per rate.
    """
    from vla_zenoh.lab.cli.loopback import own_address
    from vla_zenoh.runtime.process import die_with_parent, stop_on_signals
    from vla_zenoh_benchmarks.command_runner import measure_command

    rates_hz = number_list("--rates", rates, 50, 1000)
    chosen = effective_profile(profile)
    chosen.require_one_arm("the motion of bench command")
    with kept_rows(result, _tables) as rows:
        stop = stop_on_signals()
        die_with_parent()
        loaded = own_address(chosen)
        for rate_hz in track(rates_hz, "command node", console=errors()):
            rows.append(measure_command(loaded, rate_hz, seconds, stop, rows.log, busy))


def _tables(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    times = [f"{name} {share}" for name in ("tick us", "late us", "pose ms") for share in SHARES]
    columns = ("set Hz", "held Hz", "missed", "bare loop", "core share", *times)
    table = new_table(*columns, left=())
    for row in rows:
        table.add_row(
            f"{row['command_hz']:g}",
            f"{row['held_hz']:g}",
            f"{row['missed_ticks']}",
            f"{row['bare_missed_ticks']} of {row['bare_ticks']}",
            f"{row['core_share']:.2f}",
            *(f"{row['tick_us'][share]:.0f}" for share in SHARES),
            *(f"{row['late_us'][share]:.0f}" for share in SHARES),
            *(f"{row['pose_age_ms'][share]:.0f}" for share in SHARES),
        )
    text = (
        "bare loop: ticks that one missed which only sleeps. tick: from wake-up to the published "
        "command. late: wake-up after its time. pose: its age"
    )
    realtime = all(row["realtime"] for row in rows)
    table.caption = text if realtime else f"{text} (no real-time priority here)"
    return [table]
