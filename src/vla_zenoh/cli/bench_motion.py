"""vla-zenoh bench motion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from vla_zenoh.cli.options import DEFAULT_PROFILE, effective_profile
from vla_zenoh.cli.output import console, errors

THESIS: dict[str, dict[float, str]] = {
    # path length over 50 requests of its Table 5.2, where it published one
    "go up": {1.0: "0.248 m", 5.0: "0.121 m"},
    "yaw right": {1.0: "1.248 rad", 5.0: "1.003 rad"},
    "pitch down": {1.0: "0.238 rad", 5.0: "0.285 rad"},
    "roll left": {1.0: "0.043 rad", 5.0: "0.010 rad"},
}


def motion(
    rates: Annotated[str, typer.Option("--rates", help="Hz, separated by commas.")] = "1,2,5,10",
    prompts: Annotated[
        str, typer.Option("--prompts", help="'all', or motions separated by commas.")
    ] = "all",
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="Name or path of a simulated robot's profile.")
    ] = DEFAULT_PROFILE,
    worker_options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the scripted model: delay_ms=140, horizon=8, ..."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the rows to this file.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for a plot of every row.")
    ] = None,
) -> None:
    """Run the thesis's ten prompts, 50 steps each, through the real chain, and judge each.

    Exits with 0 only when every row keeps its promises.
    """
    from vla_zenoh.bench.motion import PROTOCOL, STEPS
    from vla_zenoh.cli.demo_run import own_address
    from vla_zenoh.demo.plot import plot_run
    from vla_zenoh.nodes.bench_motion import run_in_real_time
    from vla_zenoh.nodes.demo import Interrupted
    from vla_zenoh.nodes.launch import Host
    from vla_zenoh.nodes.process import die_with_parent, stop_on_signals

    rates_hz = _rates(rates)
    names = [trial.name for trial in PROTOCOL]
    wanted = names if prompts == "all" else [part.strip() for part in prompts.split(",")]
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a motion; there are: {', '.join(names)}")
    trials = [trial for trial in PROTOCOL if trial.name in wanted]
    stop = stop_on_signals()
    die_with_parent()
    loaded = own_address(effective_profile(profile))
    rows: list[dict[str, Any]] = []
    lines: list[str] = []
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    interrupted = False
    with Progress(
        TextColumn("{task.description:<34}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=errors(),
    ) as bars:
        everything = bars.add_task("all rows", total=len(trials) * len(rates_hz))
        current = bars.add_task("starting the nodes", total=STEPS)

        def progress(trial: Any, rate_hz: float, done: int) -> None:
            bars.update(current, description=f"{trial.name} at {rate_hz:g} Hz", completed=done)

        def log(node: str, line: str) -> None:
            lines.append(f"{node:>16} | {line}")

        host = Host(
            loaded,
            None,
            log=log,
            tell=log,
            own_router=True,
            worker_options={loaded.task.worker: tuple(worker_options or ())},
        )
        try:
            with host as running:
                for row, recording in run_in_real_time(running, trials, rates_hz, stop, progress):
                    rows.append(row)
                    bars.update(everything, advance=1)
                    if out is not None:
                        out.mkdir(parents=True, exist_ok=True)
                        name = f"{row['prompt'].replace(' ', '_')}_{row['rate_hz']:g}Hz.png"
                        plot_run(
                            out / name,
                            loaded,
                            recording.poses,
                            recording.commands,
                            recording.marks,
                            [],
                        )
        except Interrupted:
            interrupted = True
        except Exception:
            errors().print("\n".join(lines[-20:]), style="dim", markup=False)
            raise
        finally:
            _write(json_file, rows)
    _show(rows)
    if interrupted:
        raise typer.Exit(130)
    if not rows or not all(row["ok"] for row in rows):
        raise typer.Exit(1)


def _rates(text: str) -> list[float]:
    try:
        rates_hz = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise typer.BadParameter(f"--rates wants numbers separated by commas: {error}") from error
    if not all(0.2 <= rate_hz <= 50 for rate_hz in rates_hz):
        raise typer.BadParameter("--rates wants numbers from 0.2 to 50")
    return rates_hz


def _write(path: Path | None, rows: list[dict[str, Any]]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=2) + "\n", "utf-8")


def _show(rows: list[dict[str, Any]]) -> None:
    table = Table(title="50 steps each, measured at rest", title_justify="left")
    for column in (
        "prompt",
        "Hz",
        "asked",
        "reached",
        "off axis",
        "jerk/limit",
        "e2e p50/p95 ms",
        "thesis (path)",
        "",
    ):
        left = column in ("prompt", "")
        table.add_column(column, justify="left" if left else "right")
    for row in rows:
        table.add_row(
            row["prompt"],
            f"{row['rate_hz']:g}",
            *_amounts(row),
            f"{row['off_axis_mm']:.2f} mm {row['off_axis_rad'] * 1e3:.2f} mrad",
            f"{row['peak_jerk_over_limit']:.3f}",
            f"{row['e2e_ms_p50'] or 0:.1f} / {row['e2e_ms_p95'] or 0:.1f}",
            THESIS.get(row["prompt"], {}).get(row["rate_hz"], ""),
            "[green]ok[/]" if row["ok"] else f"[red]{'; '.join(row['faults'])}[/]",
        )
    console().print(table)


def _amounts(row: dict[str, Any]) -> tuple[str, str]:
    if row["asked_m"]:
        return f"{row['asked_m']:.4f} m", f"{row['reached_m']:.4f} m"
    if row["asked_rad"]:
        return f"{row['asked_rad']:.4f} rad", f"{row['reached_rad']:.4f} rad"
    return f"{row['asked_width_m'] * 1e3:.1f} mm", f"{row['reached_width_m'] * 1e3:.1f} mm"
