"""From what a LeRobot directory declares to cameras, state and actions of this robot."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy import Observation

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
STATE, ACTION, PICTURE = "observation.state", "action", "observation.image"
MAX_STEPS = 1000
WITHOUT_WORDS = frozenset({"act", "diffusion", "tdmpc", "vqbet"})
"""Policies that read no prompt."""
REMOTE_CODE = frozenset({"gaussian_actor", "groot", "pi0_fast"})
"""LeRobot runs code from a model hub for these."""

UPRIGHT = 1e-7
"""Cosine of a pitch so near to 90 degrees that roll and yaw turn about the same axis."""

STATE_PARTS: Mapping[str, tuple[str, int]] = {
    "joints": ("joint", 7),
    "joint_velocities": ("joint", 7),
    "position": ("pose", 3),
    "rpy": ("pose", 3),
    "rotvec": ("pose", 3),
    "quaternion": ("pose", 4),
    "gripper_m": ("gripper", 1),
    "gripper_open": ("gripper", 1),
    "gripper_closed": ("gripper", 1),
}
"""What ``observation.state`` can be made of: part of the robot's state, and how many numbers."""


def read_config(folder: Path) -> dict[str, Any]:
    """The config of a policy directory.

    Raises:
        WorkerError: it is none, or of a kind that is not run.
    """
    if not folder.is_dir():
        raise WorkerError(f"checkpoint {str(folder)!r} is not a folder")
    config = _json(folder / CONFIG)
    if not isinstance(config.get("type"), str):
        raise WorkerError(f"{folder / 'config.json'} has no type; it is not a LeRobot policy")
    if config.get("use_peft"):
        raise WorkerError(f"{folder} is an adapter; merge it with what it adapts first")
    if config["type"] in REMOTE_CODE:
        raise WorkerError(
            f"{folder} is a {config['type']!r}, for which LeRobot runs code from a model hub; "
            "such policies are not loaded"
        )
    return config


def _json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise WorkerError(f"{file} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise WorkerError(f"{file}: wanted a JSON object")
    return content


def features(folder: Path, config: Mapping[str, Any], name: str) -> dict[str, tuple[int, ...]]:
    """Feature -> shape, of ``input_features`` or ``output_features``.

    Raises:
        WorkerError: they are not there in LeRobot's form.
    """
    found = config.get(name)
    try:
        return {feature: tuple(about["shape"]) for feature, about in (found or {}).items()}
    except (AttributeError, KeyError, TypeError) as error:
        raise WorkerError(f"{folder / 'config.json'}: {name} are not of LeRobot's form") from error


def pictures(
    features: Mapping[str, tuple[int, ...]], told: str
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Camera -> its feature and (C, H, W).

    Args:
        features: of the policy.
        told: ``camera=feature,...`` where the camera is not called like the feature's last part.

    Raises:
        WorkerError: names what does not fit.
    """
    wanted = {name: shape for name, shape in features.items() if name.startswith(PICTURE)}
    pairs = [pair.partition("=")[::2] for pair in told.split(",") if pair]
    named = {feature.strip(): camera.strip() for camera, feature in pairs}
    strange = sorted(set(named) - set(wanted))
    if strange:
        raise WorkerError(
            f"cameras names {strange[0]!r}, which the policy does not know; "
            f"its pictures are: {', '.join(wanted) or 'none'} (cameras=CAMERA=FEATURE,...)"
        )
    out: dict[str, tuple[str, tuple[int, ...]]] = {}
    for feature, shape in wanted.items():
        camera = named.get(feature, feature.rpartition(".")[2])
        if camera in out:
            raise WorkerError(f"two pictures of the policy are to come from camera {camera!r}")
        if len(shape) != 3 or shape[0] != 3:
            raise WorkerError(f"{feature} has shape {shape}; wanted three colours: (3, H, W)")
        out[camera] = feature, shape
    return out


def state_parts(features: Mapping[str, tuple[int, ...]], told: str) -> list[str]:
    """Names of `STATE_PARTS` that make ``observation.state``, in order.

    Args:
        features: of the policy.
        told: the names, separated by commas.

    Raises:
        WorkerError: their numbers are not as many as the policy's, or it wants something else.
    """
    other = sorted(name for name in features if name != STATE and not name.startswith(PICTURE))
    if other:
        raise WorkerError(f"the policy needs {', '.join(other)}, which no robot here can tell")
    known = ", ".join(f"{name} ({size})" for name, (_, size) in STATE_PARTS.items())
    names = [name.strip() for name in told.split(",") if name.strip()]
    strange = [name for name in names if name not in STATE_PARTS]
    if strange:
        raise WorkerError(f"state names {strange[0]!r}; there are: {known}")
    if STATE not in features:
        if names:
            raise WorkerError(f"the policy has no {STATE}; leave --set state= out")
        return []
    size = sum(STATE_PARTS[name][1] for name in names)
    if features[STATE] != (size,):
        raise WorkerError(
            f"{STATE} has shape {features[STATE]}, --set state={told} makes ({size},); "
            f"name its parts in order: {known}"
        )
    return names


def one_by_one(config: Mapping[str, Any]) -> bool:
    """Policies that look at several observations, or average chunks, plan by themselves."""
    return config.get("n_obs_steps", 1) > 1 or config.get("temporal_ensemble_coeff") is not None


def horizon(config: Mapping[str, Any], told: str) -> int:
    """Steps of a chunk that are sent: as told, else as many as the policy was made to carry out.

    Raises:
        WorkerError: more than its chunks have.
    """
    most = config.get("chunk_size", MAX_STEPS)
    steps = told or config.get("n_action_steps", most)
    try:
        number = int(steps)
    except (TypeError, ValueError) as error:
        raise WorkerError(f"steps is {steps!r}; wanted a whole number") from error
    if not 1 <= number <= min(most, MAX_STEPS):
        raise WorkerError(f"steps is {number}; the policy's chunks have {most}")
    return number


def number(name: str, given: str) -> float:
    """An option's number.

    Raises:
        WorkerError: it is none.
    """
    try:
        return float(given)
    except ValueError as error:
        raise WorkerError(f"{name} is {given!r}; wanted a number") from error


def state_numbers(
    names: Sequence[str], observation: Observation, max_width_m: float
) -> NDArray[np.float32]:
    """(N,) ``observation.state``.

    Positions in m, angles in rad, quaternions x, y, z, w with w >= 0, rpy extrinsic x, y, z.

    Args:
        names: of `STATE_PARTS`, in order.
        observation: has the parts that these need.
        max_width_m: of the open gripper.
    """
    joint, pose, gripper = observation.joint, observation.pose, observation.gripper
    out: list[float] = []
    for name in names:
        if joint is not None and name in ("joints", "joint_velocities"):
            out += list(joint.position_rad if name == "joints" else joint.velocity_rad_s)
        elif pose is not None and name == "position":
            out += list(pose.position_m)
        elif pose is not None and name in ROTATION_FORMS:
            out += ROTATION_FORMS[name](pose.quat_xyzw)
        elif gripper is not None:
            share = gripper.width_m / max_width_m
            out.append({"gripper_m": gripper.width_m, "gripper_open": share}.get(name, 1 - share))
    return np.asarray(out, np.float32)


def quaternion(quat_xyzw: Sequence[float]) -> list[float]:
    """The same rotation with w >= 0."""
    sign = -1.0 if quat_xyzw[3] < 0 else 1.0
    return [sign * float(value) for value in quat_xyzw]


def rotvec(quat_xyzw: Sequence[float]) -> list[float]:
    """Axis times angle in rad, angle within [0, pi]."""
    x, y, z, w = quaternion(quat_xyzw)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return [factor * x, factor * y, factor * z]


def rpy(quat_xyzw: Sequence[float]) -> list[float]:
    """Roll, pitch, yaw in rad: turns about the fixed x, y, z, one after the other."""
    x, y, z, w = quaternion(quat_xyzw)
    ahead, aside = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    sine, cosine = 2 * (w * y - z * x), math.hypot(ahead, aside)
    pitch = math.atan2(sine, cosine)
    if cosine < UPRIGHT:  # only the sum, or difference, of the other two is known
        return [0.0, pitch, math.copysign(2.0, -sine) * math.atan2(x, w)]
    return [
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        pitch,
        math.atan2(aside, ahead),
    ]


ROTATION_FORMS = {"quaternion": quaternion, "rotvec": rotvec, "rpy": rpy}


def device_step(pipeline: Path) -> bool:
    """Whether a pipeline has a step that moves tensors; refuses steps named by module.

    Raises:
        WorkerError: it cannot be read, or would import what the directory names.
    """
    if not pipeline.is_file():
        raise WorkerError(
            f"{pipeline.parent} holds no {pipeline.name}; a policy from before LeRobot 0.4 is "
            "brought up to date by lerobot's own script migrate_policy_normalization.py"
        )
    steps = _json(pipeline).get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise WorkerError(f"{pipeline}: wanted a list of steps")
    for step in steps:
        if "registry_name" not in step:
            raise WorkerError(
                f"{pipeline}: step {step.get('class')!r} is not one of LeRobot's own; "
                "code that a directory names is not run"
            )
    return any(step["registry_name"] == "device_processor" for step in steps)
