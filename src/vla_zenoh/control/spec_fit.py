"""Whether a model's spec fits a profile: cameras, sizes, rates, gripper. No model is run."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.control.finding import Finding, error, note, warning
from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.profile import POSE_JOINTS, Profile

SHAPE_TOLERANCE = 0.02
"""Width by height may be stretched by this share before somebody is told."""


def findings(
    profile: Profile, spec: ModelSpec, *, worker: str, rate_hz: float | None = None
) -> list[Finding]:
    """All that does not fit.

    Args:
        profile: the effective profile.
        spec: what the model declares.
        worker: name of the worker.
        rate_hz: chunks per second asked of it; None: as the profile says.
    """
    rate_hz = rate_hz or profile.task.rate_hz
    return [
        *_cameras(profile, spec),
        *_joints(profile, spec),
        *_timing(profile, spec, rate_hz),
        *_task(profile, spec, worker),
    ]


def _cameras(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    wanted = spec.observation
    known = [camera for camera in wanted.cameras if camera.camera in profile.cameras]
    for camera in wanted.cameras:
        if camera not in known:
            yield error(
                "camera",
                f"needs camera {camera.camera!r}, the profile has: "
                f"{', '.join(profile.cameras) or 'none'}",
            )
            continue
        yield from _size(profile, camera)
        rate_hz = profile.cameras[camera.camera].rate_hz
        if wanted.max_age_s * rate_hz < 1.0:
            yield error(
                "camera_rate",
                f"camera {camera.camera!r} gives a picture every {1 / rate_hz:.2f} s, the spec "
                f"allows none older than {wanted.max_age_s:g} s",
            )
    slowest = min((profile.cameras[camera.camera].rate_hz for camera in known), default=0.0)
    if len(known) > 1 and wanted.max_skew_s * slowest < 1.0:
        yield warning(
            "camera_rate",
            f"at {slowest:g} Hz pictures may lie {1 / slowest:.3f} s apart, the spec allows "
            f"{wanted.max_skew_s:g} s: many observations will be refused",
        )


def _joints(profile: Profile, spec: ModelSpec) -> Iterator[Finding]:
    joints = len(profile.robot.arm_joints)
    if joints >= POSE_JOINTS:
        return
    short = f"robot {profile.robot.name!r} has {joints} arm joints, a pose of the TCP needs six"
    if spec.action.kind == "absolute":
        yield error(
            "too_few_joints",
            f"{short}: it cannot go straight from one absolute pose to the next, also where joint "
            "positions were made into poses; use a model whose action is delta",
        )
        return
    yield warning(
        "too_few_joints",
        f"{short}: steps that it has no joint for are shortened, to nothing at worst (limit reach)",
    )


def _size(profile: Profile, camera: CameraSpec) -> Iterator[Finding]:
    source = profile.cameras[camera.camera]
    if camera.width is None or camera.height is None:
        return
    gives, asks = f"{source.width}x{source.height}", f"{camera.width}x{camera.height}"
    if camera.resize == "none" and gives != asks:
        yield error(
            "picture_size",
            f"camera {camera.camera!r} sends {gives}, the spec asks for {asks} and says "
            "resize: none",
        )
    stretch = (source.width * camera.height) / (source.height * camera.width)
    if camera.resize == "stretch" and abs(stretch - 1.0) > SHAPE_TOLERANCE:
        yield note(
            "picture_shape",
            f"camera {camera.camera!r}: {gives} is stretched to {asks}, out of shape by "
            f"{abs(stretch - 1.0):.0%}; right if it was trained so",
        )


def _timing(profile: Profile, spec: ModelSpec, rate_hz: float) -> Iterator[Finding]:
    chunk_s = spec.action.horizon * spec.action.dt_s
    if chunk_s * rate_hz < 1.0 - 1e-9:
        yield note(
            "gaps",
            f"a chunk lasts {chunk_s:g} s and one is asked for every {1 / rate_hz:g} s: the arm "
            "waits in between",
        )
    oldest_s = profile.timing.max_observation_age_s
    if spec.observation.max_age_s > oldest_s:
        yield warning(
            "camera_rate",
            f"the spec takes observations {spec.observation.max_age_s:g} s old, the command node "
            f"refuses chunks of those over {oldest_s:g} s (timing.max_observation_age_s)",
        )


def _task(profile: Profile, spec: ModelSpec, worker: str) -> Iterator[Finding]:
    if spec.action.gripper == "none" and profile.robot.finger_joints:
        yield note("no_gripper", f"robot {profile.robot.name!r} has a gripper, the model none")
    if spec.observation.prompt and not profile.task.prompt:
        yield warning("no_prompt", "needs a prompt; task.prompt of the profile is empty")
    if worker not in profile.workers:
        yield note(
            "not_listed",
            f"the profile's workers are {', '.join(profile.workers)}; `vla-zenoh up` will not "
            f"start {worker!r}",
        )
