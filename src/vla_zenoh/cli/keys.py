"""vla-zenoh keys."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated

import typer
import zenoh
from rich.table import Table

from vla_zenoh.bus.client import Client
from vla_zenoh.cli import decode
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    JsonOption,
    ProfileOption,
    RobotOption,
)
from vla_zenoh.cli.output import console, fail, print_json
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import Keys
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import NodeStatus

MAX_NUMBER = 40
SETTINGS = ("prompt", "active", "worker", "rate", "speed")


@dataclass(slots=True)
class KeyTraffic:
    """A key and what is written on it."""

    key: str
    type: str
    writer: str
    count: int = 0
    bytes: int = 0
    rate_hz: float = 0.0
    bytes_s: float = 0.0


def keys(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
    seconds: Annotated[float, typer.Option("--seconds", "-s", help="How long to listen.")] = 2.0,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures", help="Listen to pictures too; else their rates are the cameras' word."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show which keys exist, who writes them, their type and rate."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.client() as client:
        found = _listen(client, seconds, pictures)
        found += _settings(client)
        if not pictures:
            found += pictures_of(client.keys, client.snapshot())
        why = "" if found else aim.silent(client, "keys")
    found.sort(key=lambda seen: seen.key)
    if as_json:
        print_json([asdict(seen) for seen in found])
    else:
        console().print(table(found))
    if why:
        fail(why)


def table(found: Iterable[KeyTraffic]) -> Table:
    """What a person sees."""
    out = Table(header_style="bold")
    for column in ("key", "type", "writer", "rate", "bytes/s"):
        out.add_column(column, overflow="fold")
    for seen in found:
        out.add_row(
            one_line(seen.key),
            one_line(seen.type),
            one_line(seen.writer),
            one_line(f"{seen.rate_hz:.1f} Hz" if seen.rate_hz else "", MAX_NUMBER),
            f"{seen.bytes_s:,.0f}" if seen.bytes_s else "",
        )
    return out


def _listen(robot: Client, seconds: float, pictures: bool) -> list[KeyTraffic]:
    seen: dict[str, KeyTraffic] = {}
    lock = threading.Lock()

    def take(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with lock:
            entry = seen.get(key)
            if entry is None:
                header = decode.head(sample)
                entry = seen[key] = KeyTraffic(
                    key, decode.encoding_of(sample), header["source"] if header else "?"
                )
            entry.count += 1
            entry.bytes += len(sample.payload)

    listening = [
        robot.session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False))
        for key in _expressions(robot, pictures)
    ]
    began = time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    for subscriber in listening:
        subscriber.undeclare()
    for entry in seen.values():
        entry.rate_hz, entry.bytes_s = round(entry.count / took, 2), round(entry.bytes / took)
    return list(seen.values())


def _expressions(robot: Client, pictures: bool) -> Iterable[str]:
    if pictures:
        return [robot.keys.all_keys]
    # One expression a group, without the pictures: listening makes cameras encode and send.
    below = robot.keys.all_keys.removesuffix("**")
    groups = ("state/*", "command/*", "delta/*", "spec/*", "status/*", "event/*", "sim/*", "task")
    return [below + group for group in groups]


def _settings(robot: Client) -> list[KeyTraffic]:
    out: list[KeyTraffic] = []
    for name in SETTINGS:
        key = getattr(robot.keys, name)
        for reply in robot.session.get(key, timeout=1.0):
            if reply.ok is not None:
                value = decode.text(reply.ok.payload)
                out.append(KeyTraffic(key, f"text, now {value!r}", "anyone; kept by command"))
    return out


def pictures_of(of: Keys, nodes: Mapping[str, tuple[NodeStatus, float, bool]]) -> list[KeyTraffic]:
    """Keys of pictures, by the word of the nodes that make them."""
    out: list[KeyTraffic] = []
    for name, (found, _, _) in nodes.items():
        cameras = found.detail.get("cameras")
        for camera in cameras if isinstance(cameras, dict) else ():
            rate_hz = round(float(found.rates_hz.get(camera, 0.0)), 2)
            try:
                raw, jpeg = of.camera_raw(camera), of.camera_jpeg(camera)
            except ProfileError:  # no camera of ours: anybody can write a status
                continue
            out.append(KeyTraffic(raw, "pixels, on demand", name, rate_hz=rate_hz))
            out.append(KeyTraffic(jpeg, "image/jpeg, on demand", name))
    return out
