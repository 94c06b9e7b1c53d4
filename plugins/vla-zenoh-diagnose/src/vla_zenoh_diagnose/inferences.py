"""vla-zenoh inspect: what a model got and what it answered."""

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

from vla_zenoh.cli.options import node_name, options
from vla_zenoh.cli.output import console, errors, fail, new_table
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client
from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import worker_node
from vla_zenoh.lab.cli.options import EndAfterOption
from vla_zenoh.lab.cli.output_path import ForceOption, if_wanted, output_folder
from vla_zenoh.policy import MAX_CAMERAS
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh.sanitize import one_line
from vla_zenoh_diagnose.inference_views import InferenceDebugSubscriber, InferenceView

POLL_S = 0.05
PATIENCE_S = 5.0
MAX_RAW, MAX_PROMPT = 160, 1000
"""Characters."""
MAX_NUMBERS = 32


@options
def inspect(
    target: RobotTarget,
    worker: Annotated[
        str | None, typer.Argument(parser=node_name, help="Default: all workers.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="New folder for a JPEG of every image and JSON of the rest."
        ),
    ] = None,
    force: ForceOption = False,
    seconds: EndAfterOption = None,
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", min=1, max=10**9, help="End after this many inferences."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON per inference.")
    ] = False,
) -> None:
    """Show or save inferences: images as the model got them, prompt, raw output, final action.

    The numbers of a step have the order and units that the model's spec declares. Workers publish
    inferences only while this runs.
    """
    live = console().is_terminal and not as_json
    if not live and seconds is None and count is None:
        count = 1
    received = 0
    with if_wanted(output_folder, output, force=force) as part, target.client() as client:
        stop = stop_on_signals()
        subscriber = InferenceDebugSubscriber(client.session, client.keys, worker)
        began_s = time.monotonic()
        newest: dict[str, InferenceView] = {}
        with Live(console=console(), auto_refresh=False) if live else nullcontext() as screen:
            while not stop.is_set() and not (count is not None and received >= count):
                waited_s = time.monotonic() - began_s
                if seconds is not None and waited_s > seconds:
                    break
                if not received and waited_s > PATIENCE_S:
                    break
                for view in subscriber.poll()[: None if count is None else count - received]:
                    received += 1
                    newest[view.record.worker] = view
                    if part is not None:
                        _save(part, view)
                    if as_json:
                        print(json.dumps(_mapping(view)), flush=True)
                if screen is not None:
                    screen.update(table(newest), refresh=True)
                stop.wait(POLL_S)
        subscriber.close()
        if stop.is_set() and not received:
            raise typer.Exit(130)
        if not received:
            _fail(target, client, worker)
    if not live and not as_json:
        console().print(table(newest))
    if output is not None:
        errors().print(f"{received} inferences in {output}")
    if left_out := subscriber.left_out:
        why = ", ".join(f"{reason} {count}" for reason, count in sorted(left_out.items()))
        warn(f"left out: {why}")


def _fail(target: RobotTarget, client: Client, worker: str | None) -> NoReturn:
    """End with the reason why no worker published an inference."""
    words = ("inspect", *([] if worker is None else [worker]))
    if "command" not in client.alive:
        fail(target.no_node(client, *words, kind="command node"))
    if why := target.not_operator(client.profile, *words):
        fail(f"inferences are for operators: {why}")
    nodes = client.snapshot()
    asked = [name for name in nodes if name.startswith(worker_node(worker or ""))]
    complaints = {name: str(nodes[name][0].detail.get("complaint", "")) for name in asked}
    why = "; ".join(f"{name} says: {one_line(said)}" for name, said in complaints.items() if said)
    fail(
        f"no inference of {worker or 'any worker'} of {target.named(client)}"
        f"{': ' if why else '; does it run?'}{why} (`{target.typed('status')}`)"
    )


def _mapping(view: InferenceView) -> dict[str, Any]:
    record = view.record
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
        "pictures": sorted(view.jpegs),
    }


def _save(folder: Path, view: InferenceView) -> None:
    record = view.record
    # Chunk numbers start again with a worker; no two observations have the same stamp.
    stem = f"{record.observation_stamp_ns}-{record.chunk_seq}"
    into = folder / record.worker
    into.mkdir(parents=True, exist_ok=True)
    for camera, jpeg in view.jpegs.items():
        (into / f"{stem}-{camera}.jpg").write_bytes(jpeg)
    (into / f"{stem}.json").write_text(json.dumps(_mapping(view), indent=2) + "\n", "utf-8")


def table(newest: Mapping[str, InferenceView]) -> Table:
    """A table of the newest inference of each worker."""
    out = new_table("worker", "images", "prompt", "raw", "first step", "inference")
    for worker, view in sorted(newest.items()):
        record = view.record
        images = [
            one_line(f"{camera} {_size(jpeg)}") for camera, jpeg in sorted(view.jpegs.items())
        ]
        first = record.steps[0][:MAX_NUMBERS] if len(record.steps) else ()
        more = f"\n+ {len(record.steps) - 1} more" if len(record.steps) > 1 else ""
        out.add_row(
            one_line(worker),
            "\n".join(images[:MAX_CAMERAS]),
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
