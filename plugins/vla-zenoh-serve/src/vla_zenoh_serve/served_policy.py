"""A model of ours for those who ask by names: a map of arrays to an `Observation`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_policy_servers.field_mapping import FieldSource, read_map
from vla_zenoh_policy_servers.state_vector import (
    ROTATIONS,
    StateNumbers,
    home_reference,
    parts_of,
    read_parts,
    state_numbers,
)

from vla_zenoh.errors import PeerError, RecordError, SpecError
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.plausibility import MAX_LENGTH_M, state_fault
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, check_steps, reset_of
from vla_zenoh.policy.inference import ChunkPrefix, Committed
from vla_zenoh.policy.meaning import IDENTITY, TURN_RAD, joints_as
from vla_zenoh.policy.observation import prepare_image
from vla_zenoh.profile import Profile, RobotProfile
from vla_zenoh.types import GripperState, Image, JointState, PoseState, Task, shown

ROUNDING = 0.01
"""Floats of an image that was resized are beyond 0 to 1 by this much."""
IMPLAUSIBLE = "implausible_state"
"""Reason of numbers that this arm cannot have measured."""
_OF_PART = {"pose": "position+quat_xyzw", "gripper": "gripper_m", "joint": "joint"}


@dataclass(slots=True)
class ServedPolicy:
    """What a model can be asked, and under which names.

    Args:
        fields: name -> what it holds.
        arm: that the client moves.
        robot: section of its profile; its joints are given in this order.
        states: name -> the numbers of its state.
    """

    policy: Policy
    fields: Mapping[str, FieldSource]
    arm: Kinematics
    robot: RobotProfile
    states: Mapping[str, StateNumbers]
    _followed: ChunkPrefix = field(init=False)

    def __post_init__(self) -> None:
        self._followed = ChunkPrefix(self.policy)

    @property
    def spec(self) -> ModelSpec:
        """Of the model."""
        return self.policy.spec

    @property
    def takes_committed(self) -> bool:
        """Whether it takes the steps in execution."""
        return bool(getattr(self.policy, "takes_committed", False))

    def reset(self) -> None:
        """Begin an episode."""
        self._followed = ChunkPrefix(self.policy)
        (reset_of(self.policy) or (lambda: None))()

    def infer(self, observation: Observation, committed: Committed | None) -> NDArray[np.float32]:
        """(H, D) the model's actions, checked; whoever asks is taken to execute them at once."""
        extra: dict[str, Any] = {"committed": committed} if self.takes_committed else {}
        result: Any = self.policy.infer(self._followed.with_progress(observation), **extra)
        steps = result.steps if isinstance(result, ActionSteps) else result
        checked = check_steps(self.spec.action, steps)
        self._followed.published(observation, checked, observation.stamp_wall_ns, obeyed=True)
        return checked

    def described(self) -> dict[str, str]:
        """Name -> its content, as text."""
        out: dict[str, str] = {}
        for name, source in self.fields.items():
            if source.camera:
                out[name] = (
                    f"image of camera {source.camera}, RGB, (H, W, 3) or (3, H, W), uint8, or "
                    "floats from 0 to 1"
                )
            else:
                out[name] = "text" if source.prompt else "+".join(source.parts)
        return out

    def observe(self, given: Mapping[str, Any], stamp_wall_ns: int) -> Observation:
        """An observation of what was given; names that are not asked for are passed over.

        Twists and joint velocities, which such a question does not hold, are zero.

        Raises:
            PeerError: a name is missing or holds something else, or what this arm cannot have
                measured; says what is wanted.
        """
        described = self.described()
        missing = [f"{name} ({what})" for name, what in described.items() if name not in given]
        if missing:
            raise PeerError("peer_request", f"the observation lacks {', '.join(missing)}")
        prompt, state, images = "", dict[str, Any](), dict[str, NDArray[np.uint8]]()
        cameras = {camera.camera: camera for camera in self.spec.observation.cameras}
        try:
            for name, source in self.fields.items():
                value = given[name]
                if source.prompt:
                    if not isinstance(value, str):
                        raise PeerError("peer_request", f"{name} is not text: {shown(value)}")
                    prompt = value
                elif source.camera:
                    image = Image(_pixels(name, value))
                    images[source.camera] = prepare_image(image, cameras[source.camera])
                else:
                    state |= self.states[name].decode(_numbers(name, value))
            return Observation(
                stamp_wall_ns=stamp_wall_ns,
                seq=0,
                task=Task(0, True, prompt, self.spec.name, 1.0 / self.spec.action.dt_s),
                images=images,
                **self._state(state),
            )
        except (RecordError, SpecError, ValueError, TypeError) as error:
            wanted = "; ".join(f"{name}: {what}" for name, what in described.items())
            reason = getattr(error, "reason", "peer_request")
            raise PeerError(reason, f"{error} (wanted: {wanted})") from error

    def _state(self, state: Mapping[str, Any]) -> dict[str, Any]:
        asked, out = self.spec.observation.state, dict[str, Any]()
        if "pose" in asked:
            out["pose"] = PoseState(state["position_m"], state["quat_xyzw"], np.zeros(6))
            if (away_m := float(np.linalg.norm(out["pose"].position_m))) > MAX_LENGTH_M:
                why = f"the TCP is {away_m:.4g} m from the base: is this in millimetres?"
                raise SpecError(why, IMPLAUSIBLE)
        if "gripper" in asked:
            out["gripper"] = GripperState(state["width_m"], moving=False, holding=False)
        if "joint" in asked:
            out["joint"] = self._joint(state["joint"])
        if why := state_fault(
            self.arm, self.robot.max_width_m, out.get("joint"), out.get("gripper")
        ):
            raise SpecError(why, IMPLAUSIBLE)
        return out

    def _joint(self, position_rad: NDArray[np.float64]) -> JointState:
        """The joints, those that turn without an end as the model declares them."""
        names = self.robot.arm_joints
        endless = tuple(itertools.compress(self.arm.arm_joints, self.arm.endless))
        turns, none = self.spec.action.turns, np.zeros(len(names))
        far = np.isin(names, endless) & (np.abs(position_rad) > TURN_RAD)
        if turns == "wrapped" and far.any():
            first = int(np.flatnonzero(far)[0])
            raise SpecError(
                f"joint {names[first]!r} turns without an end and is at {position_rad[first]:.4g} "
                "rad; wanted within (-pi, pi]: is this in degrees?",
                IMPLAUSIBLE,
            )
        return joints_as(JointState(names, position_rad, none, none, endless=endless), turns)


def _numbers(name: str, value: Any) -> NDArray[np.float64]:
    """(n,) of what a client sends; one number comes without a shape, too: a gripper's."""
    given = np.asarray(value)
    if given.dtype.kind not in "iuf":
        raise PeerError("peer_request", f"{name} holds no numbers: {shown(value)}")
    if not np.isfinite(given).all():
        raise PeerError("peer_request", f"{name} holds NaN or infinity: {shown(given.tolist())}")
    return np.atleast_1d(given).astype(np.float64)


def _pixels(name: str, value: Any) -> NDArray[np.uint8]:
    """(H, W, 3) of what a client sends, as openpi's own policies read it.

    Source: openpi, ``_parse_image`` of its policies: floats are from 0 to 1, and channels may come
    first.
    """
    given = np.asarray(value)
    if given.ndim != 3 or not given.size or given.dtype.kind not in "uif":
        raise PeerError("peer_request", f"{name} is no image: {shown(value)}")
    if given.shape[0] == 3 != given.shape[2]:
        given = np.moveaxis(given, 0, -1)
    most, scale, rounding, wanted = 255, 1, 0.0, "0 to 255"
    if given.dtype.kind == "f":
        most, scale, rounding, wanted = 1, 255, ROUNDING, "0 to 1, as it holds floats"
    if not (given.min() >= -rounding and given.max() <= most + rounding):
        raise PeerError(
            "peer_request",
            f"{name} holds numbers from {given.min():.4g} to {given.max():.4g}; wanted {wanted}",
        )
    return np.ascontiguousarray(scale * given.clip(0, most)).astype(np.uint8)


def make_served_policy(policy: Policy, map_option: str, profile: Profile) -> ServedPolicy:
    """The offer of a model: ``prompt`` and fields ``observation/CAMERA``, ``observation/pose``, ...

    `map_option` names things otherwise; the profile is of the arm that the client moves.

    The model is given the quaternion, of the two, that is nearer to the home orientation, whatever
    the client sends.

    Raises:
        SpecError: what the model needs is not named, or named twice.
        ProfileError, ResourceError: the kinematics of the one arm cannot be made.
    """
    profile.require_one_arm("serve policy")
    spec = policy.spec
    senses = {
        "depth": bool(spec.observation.depth),
        "a history of observations": spec.observation.history > 1,
        "wrench": "wrench" in spec.observation.state,
        "effort": "effort" in spec.observation.state,
    }
    if any(senses.values()):
        lacking = ", ".join(name for name, needed in senses.items() if needed)
        raise SpecError(f"the model needs {lacking}, which is not among what is served")
    own = {name: source for name, source in read_map(map_option).items() if source is not None}
    if any(source.blank for source in own.values()):
        raise SpecError("blank is for what is sent, not for what is asked for")
    cameras = [camera.camera for camera in spec.observation.cameras]
    named = {source.camera for source in own.values() if source.camera}
    if unknown := named - set(cameras):
        raise SpecError(f"the model has no camera {', '.join(sorted(unknown))}")
    covered = {part for source in own.values() for part in parts_of(source.parts)}
    fields = dict(own)
    for camera in cameras:
        if camera not in named:
            fields[f"observation/{camera}"] = FieldSource(camera=camera)
    for part in spec.observation.state:
        if part not in covered:
            fields[f"observation/{part}"] = FieldSource(parts=read_parts(_OF_PART[part]))
    if not any(source.prompt for source in own.values()):
        fields["prompt"] = FieldSource(prompt=True)
    parts = {part for source in fields.values() for part in source.parts}
    if "pose" in spec.observation.state and not ("position" in parts and parts & set(ROTATIONS)):
        raise SpecError(f"map must give the whole pose: position and one of {', '.join(ROTATIONS)}")
    near = home_reference(profile) if "pose" in spec.observation.state else IDENTITY
    states = {
        name: replace(state_numbers(source.parts, profile), reference=near)
        for name, source in fields.items()
        if source.parts
    }
    return ServedPolicy(policy, fields, make_kinematics(profile), profile.robot, states)
