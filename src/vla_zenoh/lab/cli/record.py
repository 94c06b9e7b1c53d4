"""vla-zenoh record."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    JsonOption,
    ProfileOption,
)
from vla_zenoh.cli.output import console, errors, fail, print_json
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.runtime.process import run_node


def record(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File; runs/record-<time>.mcap without it.")
    ] = None,
    keys: Annotated[
        list[str] | None,
        typer.Option(
            "--keys",
            "-k",
            help="These alone: a key expression below <root>/<robot>/, or whole; may be given more "
            "than once. Without it, everything but raw pictures.",
        ),
    ] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="Raw pictures too; they are 1 MB each.")
    ] = False,
    seconds: Annotated[
        float | None, typer.Option("--seconds", "-s", help="End after so long.", min=0.1)
    ] = None,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    name: Annotated[
        str, typer.Option("--name", help="Node name; a second recorder needs another one.")
    ] = "recorder",
    as_json: JsonOption = False,
) -> None:
    """Record a robot's keys into an MCAP file, until Ctrl-C.

    Foxglove, Rerun and `ros2 bag` open it. It is whole at any time, also when the recorder is
    killed or the disk is full.
    """
    from vla_zenoh.lab.recording.recorder import Recorder, RecordingResult, recorded_keys

    loaded = RobotTarget(profile, connect, host).load()
    path = out or Path("runs") / time.strftime("record-%Y%m%d-%H%M%S.mcap")
    expressions = recorded_keys(loaded.keys, keys or (), raw=raw)
    done: list[RecordingResult] = []

    def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
        recorder = Recorder(loaded, session, path, expressions=expressions, name=name)
        errors().print(f"recording into {path}; Ctrl-C ends it")
        done.append(recorder.run(stop, seconds))

    run_node(loaded, run, identity=None)
    if not done:  # interrupted before it began
        raise typer.Exit(130)
    recorded = done[0]
    if as_json:
        print_json(
            {
                "file": recorded.path,
                "seconds": recorded.seconds,
                "size_bytes": recorded.size_bytes,
                "bytes_per_s": recorded.size_bytes / max(recorded.seconds, 1e-9),
                "cpu_s": time.process_time(),
                "cpu_share": time.process_time() / max(recorded.seconds, 1e-9),
                "samples": recorded.samples,
                "dropped": recorded.dropped,
                "failure": recorded.failure,
            }
        )
    else:
        console().print(
            f"{recorded.path}: {recorded.samples.total():,} samples of "
            f"{len(recorded.samples)} keys in {recorded.seconds:.1f} s, "
            f"{recorded.size_bytes / 1e6:.1f} MB, {recorded.dropped.total()} dropped"
        )
    if recorded.dropped:
        worst = ", ".join(f"{key} {count}" for key, count in recorded.dropped.most_common(5))
        said = f"dropped, because the disk did not keep up: {worst}"
        errors().print(said, style="yellow")
    if recorded.failure:
        fail(recorded.failure)
    if not recorded.samples:
        fail("nothing was said; is a robot up? (`vla-zenoh up`)")
