"""Sections of a profile: session, timing, cameras, simulator, task and hosts."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vla_zenoh import plugins
from vla_zenoh.errors import PluginError, nearest
from vla_zenoh.plugins import CameraPlugin
from vla_zenoh.profile.section import (
    Angles,
    Distinct,
    Fault,
    Name,
    Names,
    Place,
    Point,
    Section,
    Text,
    Word,
)
from vla_zenoh.types import MAX_DEPTH_UNIT_M, MIN_DEPTH_UNIT_M

IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
FILE_PROTOCOLS = ("unixsock-stream",)
TRUSTED_PROTOCOLS = ("tls", "quic")
"""Protocols that verify certificates."""
DEFAULT_FOLDER = "~/.config/vla-zenoh/lab"
ANYWHERE = ("0.0.0.0", "[::]")

_HOST_AND_PORT = re.compile(
    r"(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9_.-]+)?\]|[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?)"
    r":(?P<port>[0-9]{1,5})"
)

_LABEL = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
"""Part of a host name between dots (RFC 1123)."""
_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
"""The same with underscores, which names of containers have, and no certificate."""


def endpoint(value: str) -> str:
    """`value` if it is an endpoint of Zenoh, or a `ValueError`."""
    protocol, slash, _ = value.partition("/")
    known = (*IP_PROTOCOLS, *FILE_PROTOCOLS)
    if not slash:
        raise ValueError(f"{value!r} is not an endpoint: write tcp/HOST:PORT, as tcp/10.0.0.2:7447")
    if protocol not in known:
        raise ValueError(
            f"{value!r}: unknown protocol{nearest(protocol, known)} Known: {', '.join(known)}"
        )
    address = address_of(value)
    if protocol in FILE_PROTOCOLS:
        if not address:
            raise ValueError(f"{value!r}: write {protocol}/PATH")
        return value
    match = _HOST_AND_PORT.fullmatch(address)
    if match is None:
        raise ValueError(f"{value!r}: write {protocol}/HOST:PORT, as {protocol}/10.0.0.2:7447")
    host = match["host"]
    if host.rpartition(".")[2].isdigit() and not _is_ipv4(host):
        raise ValueError(f"{value!r}: {host} is no IPv4 address: it has four numbers up to 255")
    if host.startswith("[") and not _is_ipv6(host[1:-1]):
        raise ValueError(f"{value!r}: {host} is no IPv6 address")
    if not host.startswith("[") and not all(map(_NAME.fullmatch, host.split("."))):
        raise ValueError(f"{value!r}: {host} is no host name")
    if int(match["port"]) > 65535:
        raise ValueError(f"{value!r}: a port is at most 65535")
    return value


def _is_ipv4(host: str) -> bool:
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True


def _is_ipv6(host: str) -> bool:
    try:
        ipaddress.IPv6Address(host)
    except ValueError:
        return False
    return True


def network_address(text: str, label: re.Pattern[str] = _LABEL) -> str:
    """`text` if it is the IP address or host name of one computer, without protocol and port.

    Args:
        label: that the parts of a host name between dots match.

    Raises:
        ValueError: it is not.
    """
    try:
        found = ipaddress.ip_address(text)
    except ValueError:
        labels = text.split(".")
        if not all(map(label.fullmatch, labels)) or labels[-1].isdigit():
            raise ValueError(
                f"{text!r} is no address: write an IP address or a host name, without protocol "
                "and port, such as 10.0.0.2, fd00::2 or lab-pc.local"
            ) from None
        return text
    if found.is_unspecified:
        raise ValueError(f"{text!r} stands for all addresses of a computer: give one of them")
    return text


def reachable_address(text: str) -> str:
    """`network_address` of what is only connected to: the name of a container will do."""
    return network_address(text, _NAME)


Address = Annotated[str, AfterValidator(reachable_address)]
"""Of a device or server that a profile names."""
Endpoint = Annotated[str, Field(max_length=512), AfterValidator(endpoint)]
Endpoints = Annotated[tuple[Endpoint, ...], Field(strict=False, max_length=16), Distinct]


def address_of(endpoint: str) -> str:
    """The address of an endpoint: ``127.0.0.1:7447`` of ``tcp/127.0.0.1:7447``."""
    return re.split(r"[?#]", endpoint.partition("/")[2], maxsplit=1)[0]


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint is on this computer: a file, ``localhost``, or a loopback address."""
    return endpoint.startswith(FILE_PROTOCOLS) or is_loopback_address(host_of(endpoint))


def is_loopback_address(address: str) -> bool:
    """`is_loopback` for an address without protocol and port."""
    host = address.partition("%")[0]
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, which may resolve to anything
        return host == "localhost"


def host_of(endpoint: str) -> str:
    """Host name or IP address of an endpoint, without brackets; empty for a file."""
    match = _HOST_AND_PORT.fullmatch(address_of(endpoint))
    return match["host"].strip("[]") if match else ""


def endpoint_faults(
    endpoints: Sequence[str], session: SessionProfile, *above: str
) -> Iterator[tuple[Place, str]]:
    """Faults of endpoints that contradict the session's security or links.

    At a place `above` that ends in ``listen`` a router listens on them; at others nodes connect.
    """
    listen = above[-1] == "listen"
    for number, endpoint in enumerate(endpoints):
        place = (*above, str(number))
        protocol = endpoint.partition("/")[0]
        trusted = protocol in TRUSTED_PROTOCOLS
        if session.security is not None and not trusted:
            why = f"{protocol} verifies no certificate, but there is a section security: write tls/"
            yield place, why
        elif session.security is None and trusted:
            yield place, f"{protocol} needs certificates: make them with `vla-zenoh secure init`"
        elif listen and not (trusted or session.insecure or is_loopback(endpoint)):
            yield (
                place,
                "lets anyone on that network command the robot. Make certificates with "
                "`vla-zenoh secure init`, or listen on 127.0.0.1, or set insecure: true",
            )
        match = _HOST_AND_PORT.fullmatch(endpoint.partition("/")[2])
        has_a_second = match is not None and 0 < int(match["port"]) < 65535
        if session.separate_links and not has_a_second:
            yield place, "separate_links needs PROTOCOL/HOST:PORT, and the next port too"


class SecurityProfile(Section):
    """Mutual TLS and access control, written by ``vla-zenoh secure init``.

    Args:
        folder: has a folder with certificates for each host: ``HOST/ca.pem``, ``HOST/NODE.pem`` and
            ``HOST/NODE.key``.
        host: of the profile that this computer is; None: as noted in the folder, or its only one.
        people: computer -> permission of its users. Users of the host with the command node may
            operate the robot, those of other hosts of the profile may view. ``replay`` may publish
            everything that a recording contains, commands included.
    """

    folder: Word = DEFAULT_FOLDER
    host: Name | None = None
    people: dict[Name, Literal["operator", "viewer", "replay"]] = Field(default_factory=dict)


class SessionProfile(Section):
    """How the nodes of a robot reach each other.

    Args:
        connect: endpoints of the router; nodes use the first that answers, and the next one when it
            is lost.
        listen: endpoints on which the router listens.
        separate_links: images use connections of their own, to the router's next port, so that a
            reader that is stuck in an image does not delay the arm.
        shared_memory: processes of one host exchange large payloads through shared memory.
        lease_ms: a silent link is closed after this.
        security: certificates and permissions; null: none, and the router listens on this computer
            only.
        insecure: listen on a network without certificates.
    """

    connect: Endpoints = ("tcp/127.0.0.1:7447",)
    listen: Endpoints = ("tcp/127.0.0.1:7447",)
    separate_links: bool = False
    shared_memory: bool = True
    lease_ms: int = Field(default=1000, ge=200, le=60000)
    security: SecurityProfile | None = None
    insecure: bool = False

    def contradictions(self) -> Iterator[Fault]:
        if not self.connect:
            yield ("connect",), "is empty: nodes need a router, as tcp/10.0.0.2:7447"
        if not self.listen:
            yield ("listen",), "is empty: the router needs an address, as tcp/[::]:7447"
        for index, endpoint in enumerate(self.connect):
            if address_of(endpoint).endswith(":0"):
                yield ("connect", str(index)), "port 0 leads nowhere"
        for name, endpoints in (("connect", self.connect), ("listen", self.listen)):
            yield from endpoint_faults(endpoints, self, name)
        if self.security is not None and self.insecure:
            yield ("insecure",), "is true, beside a section security: leave one out"


# -- the other sections ---------------------------------------------------------------------------
NodeKind = Literal["router", "sim", "ros2", "arm", "camera", "command", "worker", "primitives"]
SIMULATED: tuple[NodeKind, ...] = ("router", "sim", "camera", "command", "worker")
MIN_PERIODS = 3
"""A healthy link may be silent for up to this many periods."""


EVERYTHING = CameraPlugin(
    written="", has_lens=True, has_intrinsics=True, has_depth=True, has_locks=True
)
"""Stands for a camera source that is not installed here: another computer checks it."""


def camera_plugin(source: str) -> CameraPlugin:
    """The plug-in of a camera's source.

    Raises:
        PluginError: it is installed, and cannot be imported.
    """
    kind = source.partition(":")[0]
    if kind not in plugins.installed(plugins.CAMERAS):
        return EVERYTHING
    return plugins.load(plugins.CAMERAS, kind)


def names_file(source: str) -> bool:
    """Whether a camera's source is the path of a file or folder, behind its colon."""
    kind, colon, _ = source.partition(":")
    try:
        return bool(colon) and camera_plugin(kind).is_path
    except PluginError:
        return False


def _source(value: str) -> str:
    kind, colon, rest = value.partition(":")
    known = plugins.installed(plugins.CAMERAS)
    try:
        if not colon or not rest:
            found = plugins.load_all(plugins.CAMERAS).values()
            written = ", ".join(plugin.written for plugin in found)
            raise ValueError(f"{value!r} is not a camera: write one of {written}")
        if kind in known or (nearest(kind, known, "") and not plugins.in_own_environment()):
            plugin = plugins.load(plugins.CAMERAS, kind)
            if why := plugins.faults_of_text(kind, plugin.check, rest):
                raise ValueError(f"{value!r} {why}")
    except PluginError as error:
        raise ValueError(f"{value!r}: {error}") from error
    return value


class Timing(Section):
    """Rates and timeouts.

    Args:
        command_hz: rate of the command stream in motion; at rest it is 50 Hz.
        state_hz: rate of the simulated robot's state; a real robot has its own.
        watchdog_s: the arm brakes and holds if no new chunk arrives for this long after the last
            one ran out.
        max_hold_s: an arm that has held for this long does not move again by itself: it needs a new
            activation.
        state_timeout_s: older robot state brakes the arm, which then needs a new activation.
        command_timeout_s: the robot brakes by itself if the command stream is silent for this long.
            Until then it goes on at its last velocity, wherever that leads: 30 mm at 0.3 m/s.
        max_observation_age_s: a chunk inferred from an older observation is rejected.
        max_open_loop_s: longest part of a chunk that is followed; then it counts as run out.
            Without a new chunk the arm moves for this long, at the speed override, and watchdog_s.
        max_clock_step_s: a larger jump of the wall clock brakes the arm, which then needs a new
            activation.
        max_clock_offset_s: largest offset of another host's clock that is compensated; with a
            larger one activation is rejected.
    """

    command_hz: float = Field(default=250.0, ge=50, le=1000)
    state_hz: float = Field(default=200.0, ge=20, le=1000)
    watchdog_s: float = Field(default=0.3, ge=0.02, le=5)
    max_hold_s: float = Field(default=10.0, ge=1, le=3600)
    state_timeout_s: float = Field(default=0.15, ge=0.02, le=2)
    command_timeout_s: float = Field(default=0.1, ge=0.01, le=1)
    max_observation_age_s: float = Field(default=1.0, gt=0, le=10)
    max_open_loop_s: float = Field(default=2.5, ge=0.05, le=60)
    max_clock_step_s: float = Field(default=0.05, gt=0, le=1)
    max_clock_offset_s: float = Field(default=0.1, gt=0, le=1)

    def contradictions(self) -> Iterator[Fault]:
        for name, rate in (
            ("command_timeout_s", "command_hz"),
            ("watchdog_s", "command_hz"),
            ("state_timeout_s", "state_hz"),
        ):
            wait_s, rate_hz = getattr(self, name), getattr(self, rate)
            if wait_s * rate_hz < MIN_PERIODS - 1e-9:
                why = f"is {wait_s:g}, less than {MIN_PERIODS} periods of {rate} ({rate_hz:g})"
                yield (name,), why


class Composition(Section):
    """How overlapping chunks are combined; see `vla_zenoh.control.plan_timeline`.

    Args:
        mode: ``replace``: only the newest chunk; ``blend``: it takes over from the previous one
            within a window; ``ensemble``: the weighted mean of all chunks in force.
        blend_s: window of ``blend``.
        ensemble_decay: m of ``ensemble``: chunk i, 0 the oldest, has the weight exp(-m i).
        ensemble_plans: largest number of chunks in the mean, the newest ones.
        pace: ``spec``: as the model's spec says; ``steady`` or ``soonest`` overrides it, see
            `vla_zenoh.policy.ActionSpec`.
    """

    mode: Literal["replace", "blend", "ensemble"] = "replace"
    blend_s: float = Field(default=0.2, gt=0, le=2)
    ensemble_decay: float = Field(default=0.01, ge=0, le=10)
    ensemble_plans: int = Field(default=16, ge=2, le=64)
    pace: Literal["spec", "steady", "soonest"] = "spec"


class CameraCheck(Section):
    """When a camera's own images show that it cannot be trusted; see `nodes.camera.image_check`.

    A duration or contrast of 0 or a share of 1 disables that check.

    Args:
        same_s: an identical image for this long: frozen, as every sensor has noise. null: depends
            on the source: 1 for ``v4l2:``, 2 for ``ros2:``, 5 for ``rtsp:``, whose compression may
            repeat a still scene; 0 for ``sim:``, ``file:`` and virtual devices without noise. A
            worker counts as well, while the arm moves and for ``sim:`` too (1): it gives its model
            no image that repeats.
        stamp_s: the driver's time stamp does not advance for this long.
        clipped_share: largest share of the image that may be black, or white.
        contrast_levels: between the brightest and darkest parts, of 255; less is a covered lens.
        after_s: black, white, low contrast or another camera's view is a fault after this long.
        reference: file with an image of what this camera shows at its place, as `vla-zenoh camera
            list --output` writes it: cameras that have one are told from each other by it.
    """

    same_s: float | None = Field(default=None, ge=0, le=3600)
    stamp_s: float = Field(default=0.5, ge=0, le=60)
    clipped_share: float = Field(default=0.98, gt=0, le=1)
    contrast_levels: float = Field(default=5.0, ge=0, le=100)
    after_s: float = Field(default=0.5, ge=0, le=60)
    reference: Text | None = None


class Crop(Section):
    """A part of a camera's image, in its own pixels.

    Args:
        left: first column.
        top: first row.
        width: columns.
        height: rows.
    """

    left: int = Field(ge=0, le=8192)
    top: int = Field(ge=0, le=8192)
    width: int = Field(ge=16, le=8192)
    height: int = Field(ge=16, le=8192)


class CameraMount(Section):
    """Where a camera is: the pose of its optical frame, with z forward and x to the right.

    Args:
        frame: name of the optical frame in ROS, without a leading slash.
        link: what it is fixed to, a link of robot.description.
        position_m: of it in the link.
        rpy_rad: its turn in the link, extrinsic x, y, z.
    """

    frame: Word
    link: Word
    position_m: Point
    rpy_rad: Angles

    def contradictions(self) -> Iterator[Fault]:
        if self.frame.startswith("/"):
            yield ("frame",), "begins with a slash: names of tf2 have none"
        if self.frame == self.link:
            yield ("frame",), "is link: a frame cannot be its own parent"


class CameraProfile(Section):
    """A camera.

    Args:
        source: name of an installed plug-in, and what it is to read: ``sim:<camera of the scene>``,
            ``v4l2:<device>`` (a serial number, a name in /dev/v4l/by-id, or a path; `vla-zenoh
            camera list`), ``realsense:<serial number>``, ``rtsp://...``, ``rtsps://...``,
            ``file:<video or folder of images>`` (relative to the profile), ``ros2:<topic>``;
            packages bring more.
        width: of published images, pixels.
        height: of published images, pixels.
        rate_hz: largest rate of images.
        jpeg_quality: of the JPEG stream, which hosts exchange, 1 to 100.
        jpeg_rate_hz: largest rate of the JPEG stream; null: every image.
        jpeg_width: wider images are scaled down for the JPEG stream; null: never.
        depth_unit_m: metres of one count of the depth stream, 16 bits: at 0.001 it reaches 65 m in
            steps of 1 mm; null: no depth. ``sim:``, ``realsense:`` and
            ``ros2:`` have depth.
        intrinsics: YAML file with width, height, fx_px, fy_px, cx_px, cy_px and distortion (k1, k2,
            p1, p2, k3 of OpenCV) of the camera's own images; null: those that the camera reports,
            if any.
        undistort: remove the distortion of the lens, before the crop.
        crop: part of the image that is published, before it is flipped; null: all of it.
        flip: ``horizontal`` (left and right), ``vertical``, or ``both``, of a camera that is
            mounted upside down.
        exposure_us: fixed exposure; null: automatic. Of ``v4l2:`` and ``realsense:``.
        white_balance_k: fixed white balance; null: automatic. Of the same.
        fit_for_workers: also publish images in the exact size of each model's spec, for workers on
            other hosts. Every source except ``ros2:`` supports it.
        check: when its images show that it cannot be trusted.
        mount: where it is, for ``ros2.tf``; null: unknown.
    """

    source: Annotated[Word, AfterValidator(_source)]
    width: int = Field(default=640, ge=16, le=8192)
    height: int = Field(default=480, ge=16, le=8192)
    rate_hz: float = Field(default=30.0, gt=0, le=240)
    jpeg_quality: int = Field(default=90, ge=1, le=100)
    jpeg_rate_hz: float | None = Field(default=None, gt=0, le=240)
    jpeg_width: int | None = Field(default=None, ge=16, le=8192)
    depth_unit_m: float | None = Field(default=None, ge=MIN_DEPTH_UNIT_M, le=MAX_DEPTH_UNIT_M)
    intrinsics: Text | None = None
    undistort: bool = False
    crop: Crop | None = None
    flip: Literal["none", "horizontal", "vertical", "both"] = "none"
    exposure_us: float | None = Field(default=None, ge=1, le=1_000_000)
    white_balance_k: float | None = Field(default=None, ge=1000, le=20_000)
    fit_for_workers: bool = False
    check: CameraCheck = CameraCheck()
    mount: CameraMount | None = None

    def contradictions(self) -> Iterator[Fault]:
        kind, plugin = self.source.partition(":")[0], camera_plugin(self.source)
        others = plugins.load_all(plugins.CAMERAS)
        if self.depth_unit_m is not None and not plugin.has_depth:
            known = ", ".join(one.written for one in others.values() if one.has_depth)
            yield ("depth_unit_m",), f"is set, and {kind}: measures no depth; these do: {known}"
        for names, trait in (
            (("intrinsics", "undistort", "crop", "flip"), "has_lens"),
            (("exposure_us", "white_balance_k"), "has_locks"),
        ):
            for name in names:
                if getattr(self, name) not in (None, False, "none") and not getattr(plugin, trait):
                    known = ", ".join(f"{one}:" for one in others if getattr(others[one], trait))
                    yield (name,), f"is set, and works with {known} only"
        if self.undistort and self.intrinsics is None and not plugin.has_intrinsics:
            yield ("intrinsics",), "is missing: undistort needs the file with the lens"

    @property
    def same_moving_s(self) -> float:
        """How long its images may stay the same while the arm moves, s; 0: indefinitely."""
        if self.check.same_s is not None:
            return self.check.same_s
        return camera_plugin(self.source).same_moving_s

    @property
    def from_ros2(self) -> bool:
        """The node ros2 publishes it, and no camera node."""
        return self.source.startswith("ros2:")


class SimProfile(Section):
    """The simulator.

    Args:
        scene: folder under sim/.
        joint_friction_nm: Coulomb friction in every arm joint.
        seed: of the first placement of the objects.
        vary: what else a seed randomizes beside the placement; the scene has to support it.
        renderer: ``auto`` uses OpenGL if it works, else ray casting.
    """

    scene: Word = "table"
    joint_friction_nm: float = Field(default=0.0, ge=0, le=10)
    seed: int = Field(default=0, ge=0)
    vary: Annotated[
        tuple[Literal["lights", "table", "camera", "distractors"], ...],
        Field(strict=False),
        Distinct,
    ] = ()
    renderer: Literal["auto", "egl", "raycast"] = "auto"


class TaskProfile(Section):
    """Initial values of the settings.

    Args:
        prompt: instruction for the model. The plan of an old prompt, or worker, is followed until
            the first chunk of the new one, for timing.max_open_loop_s and watchdog_s at most.
        rate_hz: requested rate of chunks.
        worker: whose chunks move the arm.
        speed_percent: share of the planned speed.
    """

    prompt: Text = "hold"
    rate_hz: float = Field(default=5.0, ge=0.05, le=100)
    worker: Name = "scripted"
    speed_percent: float = Field(default=100.0, ge=0, le=100)


class HostProfile(Section):
    """One computer: which nodes run there, and how they reach the router.

    Args:
        nodes: kinds of nodes.
        connect: endpoints of the router as seen from there; None: those of session.connect. With
            two routers the host switches to the second one when the first is lost.
        listen: endpoints of this host's router; None: those of session.listen.
        link: routers of other hosts that this host's router connects to.
        cameras: served by its camera node; None: all.
        workers: that it runs; None: all.
    """

    nodes: Annotated[tuple[NodeKind, ...], Field(strict=False), Distinct]
    connect: Endpoints | None = None
    listen: Endpoints | None = None
    link: Endpoints | None = None
    cameras: Names | None = None
    workers: Names | None = None
