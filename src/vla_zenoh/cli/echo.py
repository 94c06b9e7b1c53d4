"""vla-zenoh echo."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer
import zenoh
from rich.pretty import pretty_repr

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli import decode
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    JsonOption,
    ProfileOption,
)
from vla_zenoh.cli.output import console, fail, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.codec.image import MAX_IMAGE_BYTES

POLL_S = 0.02


def echo(
    key: Annotated[
        str,
        typer.Argument(help="Below <root>/<robot>/, such as state/pose or 'event/*'; or whole."),
    ],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    count: Annotated[int | None, typer.Option("--count", "-n", help="End after so many.")] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", "-s", help="End after so long.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print what is written on a key, decoded."""
    loaded = RobotTarget(profile, connect, host).load()
    whole = key if key.startswith(f"{loaded.root}/") else f"{loaded.root}/{loaded.robot.name}/{key}"
    inbox, seen = CallbackRing(256, MAX_IMAGE_BYTES), 0
    with open_session(loaded.session) as session:
        try:
            subscriber = session.declare_subscriber(
                whole, zenoh.handlers.Callback(inbox, indirect=False)
            )
        except zenoh.ZError as error:
            fail(f"{whole!r} is not a key expression: {error}", 2)
        end = time.monotonic() + seconds if seconds is not None else None
        while (count is None or seen < count) and (end is None or time.monotonic() < end):
            for arrival in inbox.drain():
                _show(arrival.sample, as_json)
                seen += 1
                if count is not None and seen >= count:
                    break
            time.sleep(POLL_S)
        subscriber.undeclare()
    if not seen:
        fail(f"nothing was written on {whole}")


def _show(sample: zenoh.Sample, as_json: bool) -> None:
    header, content = decode.head(sample), decode.content(sample)
    if as_json:
        line = {"key": str(sample.key_expr), "header": header, "value": content}
        print(json.dumps(line), flush=True)
        return
    stamp = f" seq {header['seq']} by {header['source']}" if header else ""
    out = console()
    out.print(styled(sample.key_expr, "bold cyan"), styled(stamp, "dim"), sep="")
    text = content if isinstance(content, str) else pretty_repr(content, max_width=out.width)
    out.print(text)
