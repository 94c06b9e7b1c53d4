"""vla-zenoh keys, echo: which keys there are, and what is published on one."""

from __future__ import annotations

import dataclasses
import json
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import typer
import zenoh
from rich.pretty import pretty_repr
from rich.table import Table

from vla_zenoh.bus.buffers import CallbackRing, bytes_of, header_of
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import MAX_SECONDS, JsonOption, key_expression, options
from vla_zenoh.cli.output import console, fail, new_table, styled
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client
from vla_zenoh.codec import message
from vla_zenoh.codec.image import MAX_IMAGE_BYTES
from vla_zenoh.errors import CodecError, ProfileError, nearest
from vla_zenoh.keys import KEY_PATHS, PART_KEYS, Keys
from vla_zenoh.lab.cli.options import EndAfterOption
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.profile import Profile
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import NodeStatus

MAX_NUMBER, MAX_TEXT = 40, 400
"""Characters."""
POLL_S = 0.02
PATIENCE_S = 3.0
"""Without a sample for this long, `echo` says so, once."""
LINK_S = 0.5
"""How often `echo` looks for its link to the router, and how long it tries to get it back."""
SETTINGS = ("prompt", "active", "worker", "rate", "speed")


@dataclass(slots=True)
class KeyTraffic:
    """A key and what is published on it."""

    key: str
    type: str
    writer: str
    count: int = 0
    bytes: int = 0
    rate_hz: float = 0.0
    bytes_s: float = 0.0


@options
def keys(
    target: RobotTarget,
    seconds: Annotated[
        float, typer.Option("--seconds", "-s", min=0.1, max=MAX_SECONDS, help="How long to listen.")
    ] = 2.0,
    images: Annotated[
        bool,
        typer.Option(
            "--images", help="Subscribe to images too; default: take their rates from the cameras."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show which keys exist, who publishes them, their type and rate."""
    with target.client() as client:
        found = _listen(client, seconds, images) + _settings(client)
        if not images:
            found += image_keys(client.keys, client.snapshot())
        why = "" if found else target.no_node(client, "keys")
    found.sort(key=lambda traffic: traffic.key)
    if as_json:
        print_json([asdict(traffic) for traffic in found])
    else:
        console().print(table(found))
    if why:
        fail(why)


def table(found: Iterable[KeyTraffic]) -> Table:
    out = new_table("key", "type", "writer", "rate", "bytes/s")
    for traffic in found:
        out.add_row(
            one_line(traffic.key),
            one_line(traffic.type),
            one_line(traffic.writer),
            one_line(f"{traffic.rate_hz:.1f} Hz" if traffic.rate_hz else "", MAX_NUMBER),
            f"{traffic.bytes_s:,.0f}" if traffic.bytes_s else "",
        )
    return out


def _listen(robot: Client, seconds: float, images: bool) -> list[KeyTraffic]:
    found: dict[str, KeyTraffic] = {}
    lock = threading.Lock()

    def count(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with lock:
            traffic = found.get(key)
            if traffic is None:
                header = header_fields(sample)
                traffic = found[key] = KeyTraffic(
                    key, str(sample.encoding), header["source"] if header else "?"
                )
            traffic.count += 1
            traffic.bytes += len(sample.payload)

    subscribers = [
        robot.session.declare_subscriber(key, zenoh.handlers.Callback(count, indirect=False))
        for key in _expressions(robot, images)
    ]
    began = time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    for subscriber in subscribers:
        subscriber.undeclare()
    for traffic in found.values():
        traffic.rate_hz = round(traffic.count / took, 2)
        traffic.bytes_s = round(traffic.bytes / took)
    return list(found.values())


def _expressions(robot: Client, images: bool) -> Iterable[str]:
    if images:
        return [robot.keys.all_keys]
    # One expression per group, without images: a subscription makes cameras encode and send.
    below = robot.keys.all_keys.removesuffix("**")
    groups = ("state/*", "command/*", "delta/*", "spec/*", "status/*", "event/*", "sim/*", "task")
    return [below + group for group in groups]


def _settings(robot: Client) -> list[KeyTraffic]:
    out: list[KeyTraffic] = []
    for name in SETTINGS:
        key = getattr(robot.keys, name)
        for reply in robot.session.get(key, timeout=1.0):
            if reply.ok is not None:
                value = bytes_of(reply.ok.payload)[:MAX_TEXT].decode("utf-8", "replace")
                out.append(KeyTraffic(key, f"text, now {value!r}", "anyone; kept by command"))
    return out


def image_keys(of: Keys, nodes: Mapping[str, tuple[NodeStatus, float, bool]]) -> list[KeyTraffic]:
    """Keys of images, as the status of the nodes that publish them reports them."""
    out: list[KeyTraffic] = []
    for name, (found, _, _) in nodes.items():
        cameras = found.detail.get("cameras")
        for camera, detail in cameras.items() if isinstance(cameras, dict) else ():
            rate_hz = round(float(found.rates_hz.get(camera, 0.0)), 2)
            try:
                raw, jpeg = of.camera_raw(camera), of.camera_jpeg(camera)
                depth = of.camera_depth(camera)
            except ProfileError:  # not a camera's name: anyone can publish a status
                continue
            out.append(KeyTraffic(raw, "pixels, on demand", name, rate_hz=rate_hz))
            out.append(KeyTraffic(jpeg, "image/jpeg, on demand", name))
            if isinstance(detail, dict) and "depth_measured_share" in detail:
                out.append(KeyTraffic(depth, "image/png, depth of 16 bits, on demand", name))
    return out


@options
def echo(
    key: Annotated[
        str,
        typer.Argument(
            parser=key_expression,
            help="Below <root>/<robot>/, such as state/pose or 'event/*'; or whole.",
        ),
    ],
    target: RobotTarget,
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", min=1, max=10**9, help="End after this many samples."),
    ] = None,
    seconds: EndAfterOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print what is published on a key, decoded."""
    profile = target.load()
    whole = profile.keys.full(key)
    inbox, printed = CallbackRing(256, MAX_IMAGE_BYTES), 0
    with open_session(profile.session) as session:
        try:
            subscriber = session.declare_subscriber(
                whole, zenoh.handlers.Callback(inbox, indirect=False)
            )
        except zenoh.ZError as error:
            fail(f"{whole!r} is not a key expression: {error}", 2)
        began = now = time.monotonic()
        look_at, hinted = began + LINK_S, False
        while (count is None or printed < count) and (seconds is None or now < began + seconds):
            for arrival in inbox.drain():
                _print_sample(arrival.sample, as_json)
                printed += 1
                if count is not None and printed >= count:
                    break
            time.sleep(POLL_S)
            now = time.monotonic()
            if not (printed or hinted) and now > began + PATIENCE_S:
                warn(f"nothing on {whole} yet{meant(key, profile)}")
                hinted = True
            if now > look_at:
                look_at = now + LINK_S
                if not list(session.info.links()):
                    open_session(profile.session, wait_s=LINK_S).close()  # or raise: no router
        subscriber.undeclare()
    if not printed:
        fail(f"nothing was published on {whole}{meant(key, profile)}")


def meant(key: str, profile: Profile) -> str:
    """The known key that `key` is like, else where to look; ends a sentence."""
    whole = profile.keys.full(key)
    robot = Keys.of(whole, profile.root) or profile.keys
    known: list[str] = []
    for name, path in KEY_PATHS.items():
        for part in profile.part_names if name in PART_KEYS else ("",):
            any_of = ["*"] * len(path.parameters)
            known.append(robot.short(path.text(robot.of_part(part), *any_of)))
    otherwise = "; `vla-zenoh keys` shows those that exist"
    wanted = zenoh.KeyExpr(whole)
    if any(wanted.intersects(zenoh.KeyExpr(robot.full(one))) for one in known):
        return otherwise
    return nearest(robot.short(whole), known, otherwise)


def _print_sample(sample: zenoh.Sample, as_json: bool) -> None:
    header, value = header_fields(sample), _content(sample)
    if as_json:
        line = {"key": str(sample.key_expr), "header": header, "value": value}
        print(json.dumps(line), flush=True)
        return
    stamp = f" seq {header['seq']} by {header['source']}" if header else ""
    out = console()
    out.print(styled(sample.key_expr, "bold cyan"), styled(stamp, "dim"), sep="")
    out.print(value if isinstance(value, str) else pretty_repr(value, max_width=out.width))


def header_fields(sample: zenoh.Sample) -> dict[str, Any] | None:
    """The header of a sample; None where there is none that can be decoded."""
    try:
        return dataclasses.asdict(header_of(sample))
    except CodecError:
        return None


def _content(sample: zenoh.Sample) -> Any:
    encoding = str(sample.encoding)
    try:
        return decode(bytes_of(sample.payload, message.MAX_PAYLOAD_BYTES), encoding)
    except CodecError as error:
        return f"<{encoding}: {error}>"


def decode(payload: bytes, encoding: str) -> Any:
    """Decode a payload as its encoding says, else as text; of images and other bytes the size."""
    if encoding.startswith("application/msgpack"):
        try:
            return _json_types(message.unpack(payload))
        except CodecError as error:
            return f"<{error}>"
    if "rgb8" in encoding or encoding.startswith("image/"):
        return f"<{encoding}, {len(payload)} bytes>"
    try:
        return payload[:MAX_TEXT].decode("utf-8")
    except UnicodeDecodeError:
        return f"<{len(payload)} bytes>"


def _json_types(value: Any) -> Any:
    """Numbers with six digits, bytes as their number, so that a reader sees them and JSON can carry
    it."""
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, dict):
        return {str(key): _json_types(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json_types(item) for item in value]
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)
