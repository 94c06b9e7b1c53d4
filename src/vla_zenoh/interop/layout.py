"""How a policy server's names and numbers stand to ours: what it is sent, what its answer means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import PeerError
from vla_zenoh.interop.joints import Forward, poses_of
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation
from vla_zenoh.state_vector import state_vector
from vla_zenoh.types import shown

Action = Literal["delta", "absolute", "joint_delta", "joint_position"]
TheirRotation = Literal["rpy", "rotvec", "quat_xyzw", "quat_wxyz"]


@dataclass(frozen=True, slots=True)
class Source:
    """What one of the server's names is filled with.

    Args:
        camera: a picture of this camera, or empty.
        parts: of the state, may be none.
        prompt: the prompt.
        blank: height and width of a black picture.
    """

    camera: str = ""
    parts: tuple[str, ...] = ()
    prompt: bool = False
    blank: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Layout:
    """See the module. Made by `read_layout`.

    Args:
        fields: the server's name -> what it is filled with.
        spec: what our side is told.
        keys: names in the answer.
        columns: of the answer, None: all.
        action: what the arm's numbers are.
        rotation: in which form the answer has it.
        clip: bound of the arm's raw numbers.
        scales: (position, rotation, joint) one unit in m, rad, rad.
        max_width_m: of our gripper.
    """

    fields: Mapping[str, Source]
    spec: ModelSpec
    keys: tuple[str, ...]
    columns: tuple[int, ...] | None
    action: Action
    rotation: TheirRotation
    clip: float
    scales: tuple[float, float, float]
    max_width_m: float

    @property
    def needs_joints(self) -> bool:
        """Its answers are joints, so forward kinematics are needed."""
        return self.action in ("joint_delta", "joint_position")

    @property
    def width(self) -> int | None:
        """Columns of an answer, None where only the arm knows how many joints it has."""
        if self.columns is not None:
            return len(self.columns)
        if self.needs_joints:
            return None
        turns = 4 if self.rotation.startswith("quat") else 3
        return 3 + turns + (self.spec.action.gripper != "none")

    # -- out ----------------------------------------------------------------------------------
    def request(self, observation: Observation) -> dict[str, Any]:
        """The server's names with pictures (H, W, 3) uint8, numbers (n,) float32 and text."""
        out: dict[str, Any] = {}
        for theirs, source in self.fields.items():
            if source.camera:
                out[theirs] = observation.images[source.camera]
            elif source.blank:
                out[theirs] = np.zeros((*source.blank, 3), np.uint8)
            elif source.prompt:
                out[theirs] = observation.prompt
            else:
                out[theirs] = state_vector(source.parts, observation, self.max_width_m)
        return out

    # -- in -----------------------------------------------------------------------------------
    def gather(self, answer: Any) -> NDArray[np.float64]:
        """(H, C) of an answer: an array, or a map of arrays under `keys`.

        Raises:
            PeerError: names are missing, shapes do not go together, or a number is not finite.
        """
        if isinstance(answer, Mapping):
            missing = [key for key in self.keys if key not in answer]
            if missing:
                raise PeerError(
                    "peer_reply",
                    f"the answer has no {', '.join(map(repr, missing))}; it has: "
                    + ", ".join(map(str, list(answer)[:20])),
                )
            parts = [_matrix(key, answer[key], len(self.keys) > 1) for key in self.keys]
        else:
            parts = [_matrix("actions", answer, False)]
        if len({len(part) for part in parts}) != 1:
            counts = ", ".join(f"{k} {len(p)}" for k, p in zip(self.keys, parts, strict=True))
            raise PeerError("peer_reply", f"parts of the answer differ in their steps: {counts}")
        rows = np.concatenate(parts, axis=1)
        if self.columns is not None:
            if max(self.columns) >= rows.shape[1]:
                raise PeerError(
                    "peer_reply",
                    f"the answer has {rows.shape[1]} columns, column {max(self.columns)} is wanted",
                )
            rows = rows[:, list(self.columns)]
        if len(rows) == 0:
            raise PeerError("peer_reply", "the answer has no steps")
        if not np.isfinite(rows).all():
            raise PeerError("peer_reply", "the answer holds NaN or infinity")
        return rows[: self.spec.action.horizon]

    def read(
        self, answer: Any, observation: Observation, forward: Forward | None = None
    ) -> ActionSteps:
        """`steps`, and what the server said for people who look at it."""
        said = self.gather(answer)[0].tolist()
        return ActionSteps(self.steps(answer, observation, forward), raw={"first_step": said})

    def steps(
        self, answer: Any, observation: Observation, forward: Forward | None = None
    ) -> NDArray[np.float64]:
        """(H, D) in the meaning of `spec`.

        Args:
            answer: see `gather`.
            observation: what was asked about: where joint deltas begin.
            forward: kinematics, where the answers are joints.

        Raises:
            PeerError: see `gather`; also another number of columns.
        """
        rows = self.gather(answer)
        grips = int(self.spec.action.gripper != "none")
        arm, gripper = rows[:, : rows.shape[1] - grips], rows[:, rows.shape[1] - grips :]
        if self.clip:
            arm = arm.clip(-self.clip, self.clip)
        arm = (
            self._by_joints(arm, observation, forward)
            if self.needs_joints
            else self._by_pose(arm, rows.shape[1])
        )
        return np.concatenate([arm, gripper], axis=1)

    def _by_pose(self, arm: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
        turns = 4 if self.rotation.startswith("quat") else 3
        if arm.shape[1] != 3 + turns:
            grip = "" if self.spec.action.gripper == "none" else " + gripper 1"
            raise PeerError(
                "peer_reply",
                f"the answer has {columns} columns, wanted {self.spec.action.dimension}: "
                f"position 3 + {self.rotation} {turns}{grip}; choose them with columns=",
            )
        position, rotation = arm[:, :3] * self.scales[0], arm[:, 3:]
        if turns == 3:
            rotation = rotation * self.scales[1]
        else:
            norm = np.linalg.norm(rotation, axis=1, keepdims=True)
            if (abs(norm - 1.0) > 0.1).any():
                raise PeerError("peer_reply", f"a quaternion of norm {norm.min():.3g}; wanted 1")
            rotation = np.roll(rotation / norm, 0 if self.rotation == "quat_xyzw" else -1, axis=1)
        return np.concatenate([position, rotation], axis=1)

    def _by_joints(
        self, arm: NDArray[np.float64], observation: Observation, forward: Forward | None
    ) -> NDArray[np.float64]:
        measured = observation.joint
        assert measured is not None
        assert forward is not None
        if arm.shape[1] != len(measured.names):
            raise PeerError(
                "peer_reply",
                f"the answer has {arm.shape[1]} joints, the arm has {len(measured.names)}; "
                "choose them with columns=",
            )
        return poses_of(
            arm * self.scales[2], measured, forward, deltas=self.action == "joint_delta"
        )


def _matrix(name: str, value: Any, named: bool) -> NDArray[np.float64]:
    """(H, C); a batch of one is unpacked. One row of numbers is H single ones if it is `named`."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError, TypeError) as error:
        raise PeerError("peer_reply", f"{name} is not a table of numbers: {error}") from error
    if array.dtype.kind not in "iuf":
        raise PeerError("peer_reply", f"{name} is not numbers but {shown(value)}")
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 1:
        array = array[:, None] if named else array[None]
    if array.ndim != 2:
        raise PeerError("peer_reply", f"{name} has shape {array.shape}, wanted (H, D)")
    return array.astype(np.float64)
