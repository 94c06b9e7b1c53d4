"""vla-zenoh record: a robot's keys in an MCAP file."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vla_zenoh.cli.options import JsonOption, key_expression, node_name, options
from vla_zenoh.cli.output import console, errors, fail
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import counted
from vla_zenoh.lab.cli.options import EndAfterOption
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.cli.output_path import RUNS, ForceOption, output_file
from vla_zenoh.runtime.process import run_node

if TYPE_CHECKING:
    from vla_zenoh.lab.recording.recorder import RecordingResult

SHOWN = 5


@options
def record(
    target: RobotTarget,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File; default: runs/record-<time>.mcap.")
    ] = None,
    force: ForceOption = False,
    keys: Annotated[
        list[str] | None,
        typer.Option(
            "--keys",
            "-k",
            parser=key_expression,
            help="Only these: a key expression below <root>/<robot>/, or whole; repeatable. "
            "Default: everything but raw images.",
        ),
    ] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Raw images too; they are 1 MB each.")] = False,
    seconds: EndAfterOption = None,
    name: Annotated[
        str,
        typer.Option(
            "--name", parser=node_name, help="Node name; a second recorder needs another one."
        ),
    ] = "recorder",
    min_share: Annotated[
        float,
        typer.Option(
            "--min-share",
            help="Exit status 1 if less of a stream is recorded than this share of what its sender "
            "announced.",
            min=0.0,
            max=1.0,
        ),
    ] = 0.95,
    as_json: JsonOption = False,
) -> None:
    """Record a robot's keys into an MCAP file, until Ctrl-C.

    Foxglove, Rerun and `ros2 bag` open it. Until it is finished it is FILE.part.mcap, which is
    valid at any time, also when the recorder is killed or the disk is full.
    """
    from vla_zenoh.bus.reception import REMEDY
    from vla_zenoh.lab.recording.recorder import Recorder, recorded_keys

    loaded = target.load()
    path = output or RUNS / time.strftime("record-%Y%m%d-%H%M%S.mcap")
    expressions = recorded_keys(loaded.keys_of_all_parts, keys or (), raw=raw)
    done: list[RecordingResult] = []

    with output_file(path, force=force) as part:

        def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
            recorder = Recorder(loaded, session, part, expressions=expressions, name=name)
            errors().print(f"recording into {path}; Ctrl-C ends it")
            done.append(recorder.run(stop, seconds))

        run_node(loaded, run, identity=None)
        if not done:  # interrupted before it began
            raise typer.Exit(130)
        if done[0].failure:
            _show(done[0], part, as_json)
            fail(done[0].failure)
    _show(done[0], path, as_json)
    if not done[0].samples:
        fail("nothing was published; is a robot up? (`vla-zenoh up`)")
    if done[0].unreadable:
        fail(
            f"{done[0].unreadable:,} records cannot be read from this file by any vla-zenoh: "
            f"{done[0].unreadable_why}, and record again"
        )
    if short := {key: one for key, one in done[0].streams.items() if one.below(min_share)}:
        rows = [
            f"{loaded.keys.short(key)} {share.received} of {share.sent}"
            for key, share in sorted(short.items(), key=lambda item: -item[1].lost)
        ]
        more = f" and {len(rows) - SHOWN} more" if len(rows) > SHOWN else ""
        fail(
            f"samples are missing (--min-share {min_share:g}), recorded of those announced: "
            f"{', '.join(rows[:SHOWN])}{more}; {REMEDY}"
        )


def _show(recorded: RecordingResult, path: Path, as_json: bool) -> None:
    if as_json:
        print_json(
            {
                "file": path,
                "seconds": recorded.seconds,
                "size_bytes": recorded.size_bytes,
                "samples": recorded.samples,
                "dropped": recorded.dropped,
                "lost": recorded.lost,
                "streams": {
                    key: {"announced": one.sent, "received": one.received, "lost": one.lost}
                    for key, one in recorded.streams.items()
                },
                "unreadable": recorded.unreadable,
                "failure": recorded.failure,
            }
        )
    else:
        console().print(
            f"{path}: {recorded.samples.total():,} samples of "
            f"{counted(len(recorded.samples), 'key')} in {recorded.seconds:.1f} s, "
            f"{recorded.size_bytes / 1e6:.1f} MB, {recorded.dropped.total()} dropped, "
            f"{recorded.lost.total()} lost"
        )
    if recorded.dropped:
        worst = ", ".join(f"{key} {count}" for key, count in recorded.dropped.most_common(5))
        warn(f"dropped, because the disk did not keep up: {worst}")
