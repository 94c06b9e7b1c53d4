"""vla-zenoh seen."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.live import Live
from rich.table import Table

from vla_zenoh.bus.client import Client
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    ProfileOption,
    RobotOption,
)
from vla_zenoh.cli.output import console, errors, fail
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.errors import CodecError
from vla_zenoh.nodes.worker.inference_debug import InferenceDebugSubscriber, InferenceView
from vla_zenoh.policy import MAX_CAMERAS
from vla_zenoh.sanitize import one_line

POLL_S = 0.05
PATIENCE_S = 5.0
MAX_RAW, MAX_PROMPT = 160, 1000
"""Characters."""
MAX_NUMBERS = 32


def seen(
    worker: Annotated[
        str | None, typer.Argument(help="Whose view; that of all workers else.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for a JPEG of every picture and a JSON file of words."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", "-s", help="End after so long.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", help="End after so many inferences.", min=1)
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON for every inference.")
    ] = False,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Show or save what models see: pictures as they got them, prompt, raw output, final action.

    Workers show it only while somebody looks.
    """
    live = console().is_terminal and not as_json
    if not live and seconds is None and count is None:
        count = 1
    aim = RobotTarget(profile, connect, host, robot)
    with aim.client() as client:
        listener = InferenceDebugSubscriber(client.session, client.keys, worker)
        began_s = time.monotonic()
        told = 0
        newest: dict[str, InferenceView] = {}
        with Live(console=console(), auto_refresh=False) if live else nullcontext() as screen:
            while not (count is not None and told >= count):
                waited_s = time.monotonic() - began_s
                if seconds is not None and waited_s > seconds:
                    break
                if not told and waited_s > PATIENCE_S:
                    break
                for sight in listener.poll()[: None if count is None else count - told]:
                    told += 1
                    newest[sight.record.worker] = sight
                    if out is not None:
                        _save(out, sight)
                    if as_json:
                        print(json.dumps(_plain(sight)), flush=True)
                if screen is not None:
                    screen.update(table(newest), refresh=True)
                time.sleep(POLL_S)
        listener.close()
        if not told:
            _complain(aim, client, worker)
    if not live and not as_json:
        console().print(table(newest))
    if out is not None:
        errors().print(f"{told} inferences in {out}")
    if left_out := listener.left_out:
        why = ", ".join(f"{reason} {count}" for reason, count in sorted(left_out.items()))
        errors().print(f"left out: {why}", style="yellow")


def _complain(aim: RobotTarget, client: Client, worker: str | None) -> NoReturn:
    """Ends the command: nobody showed anything."""
    words = ("seen",) if worker is None else ("seen", worker)
    if "command" not in client.alive:
        fail(aim.absent(client, *words))
    if why := aim.powerless(client.profile, *words):
        fail(f"what models see is shown to operators: {why}")
    fail(
        f"{worker or 'no worker'} of {aim.named(client)} shows nothing; does it infer? "
        f"(`{aim.typed('status')}`)"
    )


def _plain(sight: InferenceView) -> dict[str, Any]:
    record = sight.record
    return {
        "worker": record.worker,
        "chunk_seq": record.chunk_seq,
        "spec_hash": record.spec_hash,
        "episode": record.episode,
        "observation_stamp_ns": record.observation_stamp_ns,
        "prompt": record.prompt,
        "raw": record.raw,
        "steps": [[round(float(v), 6) for v in row] for row in record.steps],
        "done": record.done,
        "inference_ms": round(record.inference_ms, 3),
        "pictures": sorted(sight.jpegs),
    }


def _save(folder: Path, sight: InferenceView) -> None:
    record = sight.record
    # Two runs of a worker may have the same numbers; no two observations the same stamp.
    stem = f"{record.observation_stamp_ns}-{record.chunk_seq}"
    into = folder / record.worker
    into.mkdir(parents=True, exist_ok=True)
    for camera, jpeg in sight.jpegs.items():
        (into / f"{stem}-{camera}.jpg").write_bytes(jpeg)
    (into / f"{stem}.json").write_text(json.dumps(_plain(sight), indent=2) + "\n", "utf-8")


def table(newest: Mapping[str, InferenceView]) -> Table:
    """What a person sees: worker -> its newest inference."""
    out = Table(header_style="bold")
    for column in ("worker", "sees", "prompt", "raw", "first step", "inference"):
        out.add_column(column, overflow="fold")
    for name, sight in sorted(newest.items()):
        record = sight.record
        sees = [one_line(f"{camera} {_size(jpeg)}") for camera, jpeg in sorted(sight.jpegs.items())]
        first = record.steps[0][:MAX_NUMBERS] if len(record.steps) else ()
        more = f"\n+ {len(record.steps) - 1} more" if len(record.steps) > 1 else ""
        out.add_row(
            one_line(name),
            "\n".join(sees[:MAX_CAMERAS]),
            one_line(record.prompt, MAX_PROMPT),
            one_line(json.dumps(record.raw) if record.raw else "", MAX_RAW),
            " ".join(f"{value:.4g}" for value in first) + more,
            f"{record.inference_ms:.4g} ms\nchunk {record.chunk_seq}",
        )
    return out


def _size(jpeg: bytes) -> str:
    try:
        height, width, _ = decode_jpeg(jpeg).rgb.shape
    except CodecError as error:
        return str(error)
    return f"{width}x{height}"
