"""What a profile may say. Frozen records; every field has its unit in its name.

Defaults are the safe choice, so a profile that says nothing about limits has limits.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from vla_zenoh.profile.section import (
    Distinct,
    Name,
    Names,
    Section,
    Text,
    Word,
    reject,
)
from vla_zenoh.profile.session import Endpoints

NodeKind = Literal["router", "sim", "ros2", "arm", "camera", "command", "worker"]
NODE_KINDS: tuple[NodeKind, ...] = (
    "router",
    "sim",
    "ros2",
    "arm",
    "camera",
    "command",
    "worker",
)
SIMULATED: tuple[NodeKind, ...] = ("router", "sim", "camera", "command", "worker")
CAMERA_SOURCES = ("sim:CAMERA", "v4l2:DEVICE", "rtsp://...", "file:PATH", "ros2:TOPIC")
MIN_PERIODS = 3
"""A silence shorter than this many periods happens on a healthy link."""


def _source(value: str) -> str:
    kind, colon, rest = value.partition(":")
    if not colon or not rest or kind not in ("sim", "v4l2", "rtsp", "rtsps", "file", "ros2"):
        raise ValueError(f"{value!r} is not a camera: write one of {', '.join(CAMERA_SOURCES)}")
    if kind in ("rtsp", "rtsps") and not rest.removeprefix("//"):
        raise ValueError(f"{value!r} lacks the host: write rtsp://HOST/PATH")
    return value


class Timing(Section):
    """Rates and patience.

    Args:
        command_hz: of the pose stream.
        state_hz: of the robot's state (the simulator's; a real robot has its own).
        watchdog_s: no fresh chunk for this long after the last one ran out: brake and hold.
        max_hold_s: an arm that held for so long needs activation again.
        state_timeout_s: robot state older than this: brake, and activation is needed again.
        command_timeout_s: pose stream silent for this long: the robot side brakes by itself.
        max_observation_age_s: a chunk made from an older observation is refused.
        max_open_loop_s: of a chunk no more is followed; then it counts as run out.
        max_clock_step_s: the wall clock jumped by more: brake, and activation is needed again.
        max_clock_offset_s: another host's clock may differ by this much, which is then reckoned
            with; beyond it activation is refused.
    """

    command_hz: float = Field(default=250.0, ge=50, le=1000)
    state_hz: float = Field(default=200.0, ge=20, le=1000)
    watchdog_s: float = Field(default=0.3, ge=0.02, le=5)
    max_hold_s: float = Field(default=60.0, ge=1, le=3600)
    state_timeout_s: float = Field(default=0.15, ge=0.02, le=2)
    command_timeout_s: float = Field(default=0.1, ge=0.01, le=1)
    max_observation_age_s: float = Field(default=1.0, gt=0, le=10)
    max_open_loop_s: float = Field(default=2.5, ge=0.05, le=60)
    max_clock_step_s: float = Field(default=0.05, gt=0, le=1)
    max_clock_offset_s: float = Field(default=0.1, gt=0, le=1)

    @model_validator(mode="after")
    def _patience_outlasts_the_rate(self) -> Timing:
        reject(
            [
                ((name,), f"is {wait_s:g}, less than {MIN_PERIODS} periods of {rate} ({rate_hz:g})")
                for name, wait_s, rate, rate_hz in (
                    ("command_timeout_s", self.command_timeout_s, "command_hz", self.command_hz),
                    ("watchdog_s", self.watchdog_s, "command_hz", self.command_hz),
                    ("state_timeout_s", self.state_timeout_s, "state_hz", self.state_hz),
                )
                if wait_s * rate_hz < MIN_PERIODS - 1e-9
            ]
        )
        return self


class Composition(Section):
    """What is followed where chunks overlap; see `vla_zenoh.control.aggregate`.

    Args:
        mode: ``replace``: the newest chunk alone; ``blend``: it takes over from the one before
            within a window; ``ensemble``: the weighted mean of all that still run.
        blend_s: the window of ``blend``.
        ensemble_decay: m of ``ensemble``: chunk i, 0 the oldest, has the weight exp(-m i).
        ensemble_plans: the newest so many chunks have a say at most.
        pace: ``spec``: as the model's spec says; ``steady`` or ``soonest``: whatever it says, see
            `vla_zenoh.policy.ActionSpec`.
    """

    mode: Literal["replace", "blend", "ensemble"] = "replace"
    blend_s: float = Field(default=0.2, gt=0, le=2)
    ensemble_decay: float = Field(default=0.01, ge=0, le=10)
    ensemble_plans: int = Field(default=16, ge=2, le=64)
    pace: Literal["spec", "steady", "soonest"] = "spec"


class CameraCheck(Section):
    """When a camera's own pictures say that it must not be believed; `nodes.camera.image_check`.

    A limit of 0, of a share 1, switches that check off.

    Args:
        same_s: the very same picture for so long: it is frozen, as a sensor has noise. null: by its
            source: 1 of ``v4l2:``, 2 of ``ros2:``, 5 of ``rtsp:``, whose compression may repeat a
            still scene; 0 of ``sim:``, ``file:`` and virtual devices, which have no noise.
        stamp_s: the driver's time stamp does not go forward for so long.
        clipped_share: share of the picture that may be black, or white.
        contrast_levels: between its brightest and darkest parts, of 255: fewer is a covered lens.
        uniform_share: share of the picture that may be one even area. Off by default: a table top
            and a hand before the lens look alike.
        after_s: black, white, without contrast or even for so long.
    """

    same_s: float | None = Field(default=None, ge=0, le=3600)
    stamp_s: float = Field(default=0.5, ge=0, le=60)
    clipped_share: float = Field(default=0.98, gt=0, le=1)
    contrast_levels: float = Field(default=5.0, ge=0, le=100)
    uniform_share: float = Field(default=1.0, gt=0, le=1)
    after_s: float = Field(default=0.5, ge=0, le=60)


class CameraProfile(Section):
    """A camera.

    Args:
        source: ``sim:<camera of the scene>``, ``v4l2:<device>`` (``v4l2:/dev/video0``),
            ``rtsp://...``, ``file:<video or folder of pictures>`` (a path beside the profile), or
            ``ros2:<topic>``.
        width: pixels published.
        height: likewise.
        rate_hz: pictures per second, at most.
        jpeg_quality: of pictures as JPEG, which is how they travel between hosts, 1 to 100.
        jpeg_rate_hz: of those at most; null: as many as there are.
        jpeg_width: wider ones are made smaller for the jpeg key; null: as they are.
        fit_for_workers: a worker on another host gets them in the very size of its spec, made
            where the camera is. Of the sources all but ``ros2:`` can.
        loop: a file starts again at its end.
        check: when its pictures say that it must not be believed.
    """

    source: Annotated[Word, AfterValidator(_source)]
    width: int = Field(default=640, ge=16, le=8192)
    height: int = Field(default=480, ge=16, le=8192)
    rate_hz: float = Field(default=30.0, gt=0, le=240)
    jpeg_quality: int = Field(default=90, ge=1, le=100)
    jpeg_rate_hz: float | None = Field(default=None, gt=0, le=240)
    jpeg_width: int | None = Field(default=None, ge=16, le=8192)
    fit_for_workers: bool = False
    loop: bool = True
    check: CameraCheck = CameraCheck()


class SimProfile(Section):
    """The simulator.

    Args:
        scene: folder under sim/.
        gains: preset of the impedance controller.
        joint_friction_nm: Coulomb friction in every arm joint.
        seed: of the first placement of the objects.
        vary: what else a seed changes, beside places; the scene has to have it.
        renderer: ``auto`` takes OpenGL where it works, else ray casting.
    """

    scene: Word = "table"
    gains: Literal["stiff", "compliant"] = "stiff"
    joint_friction_nm: float = Field(default=0.0, ge=0, le=10)
    seed: int = Field(default=0, ge=0)
    vary: Annotated[
        tuple[Literal["lights", "table", "camera", "distractors"], ...],
        Field(strict=False),
        Distinct,
    ] = ()
    renderer: Literal["auto", "egl", "osmesa", "raycast"] = "auto"


class TaskProfile(Section):
    """What the settings are until somebody puts others.

    Args:
        prompt: what the model is asked to do.
        rate_hz: chunks per second asked of the workers.
        worker: whose chunks are obeyed.
        speed_percent: of the speed that is planned, so much is driven.
    """

    prompt: Text = "hold"
    rate_hz: float = Field(default=5.0, ge=0.05, le=100)
    worker: Name = "scripted"
    speed_percent: float = Field(default=100.0, ge=0, le=100)


class HostImagesProfile(Section):
    """What of every camera travels to the workers of a host that has no cameras.

    Args:
        quality: of JPEG, 1 to 100.
        rate_hz: of each camera at most; None: as many as there are.
        width: wider ones are made smaller; None: as they are. With ``fit_for_workers`` of a camera
            a model that declares a size gets that instead.
    """

    quality: int = Field(default=80, ge=1, le=100)
    rate_hz: float | None = Field(default=None, gt=0, le=240)
    width: int | None = Field(default=None, ge=16, le=8192)


class HostProfile(Section):
    """One computer: which nodes run there, and how it reaches the router from there.

    Args:
        nodes: kinds of nodes.
        connect: where the router is seen from there; None: as session.connect says.
        listen: where the router of this host listens; None: as session.listen says.
        link: routers of other hosts that this one connects to. With two routers in ``connect`` a
            host goes on with the second one when the first is gone.
        cameras: those of its camera node; None: all.
        workers: those it runs; None: all.
        pictures: what its workers get of cameras elsewhere; None: what the cameras' own settings
            for JPEG say.
    """

    nodes: Annotated[tuple[NodeKind, ...], Field(strict=False, min_length=1), Distinct]
    connect: Endpoints | None = None
    listen: Endpoints | None = None
    link: Endpoints | None = None
    cameras: Names | None = None
    workers: Names | None = None
    pictures: HostImagesProfile | None = None
