"""Type of the record that each key carries."""

from __future__ import annotations

from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import NOT_PARTS, PART_KEYS, Keys, last_chunk
from vla_zenoh.policy import ModelSpec
from vla_zenoh.types import (
    ActionChunk,
    Event,
    GripperCommand,
    GripperState,
    InferenceDebug,
    JointCommand,
    JointState,
    NodeStatus,
    ObjectPoses,
    PoseCommand,
    PoseState,
    PrivilegedState,
    SceneState,
    Task,
)

RECORDS: tuple[type, ...] = (
    JointState,
    PoseState,
    GripperState,
    PrivilegedState,
    PoseCommand,
    JointCommand,
    GripperCommand,
    Task,
    ActionChunk,
    ModelSpec,
    NodeStatus,
    Event,
    SceneState,
    ObjectPoses,
    InferenceDebug,
)
"""Every record that has a key."""


class RecordTypes:
    """Record types of the keys of one robot; look-ups are cached."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._of_parts = {getattr(keys, member) for member in PART_KEYS}
        self._known: dict[str, type | None] = {
            keys.state_joint: JointState,
            keys.state_pose: PoseState,
            keys.state_gripper: GripperState,
            keys.state_privileged: PrivilegedState,
            keys.command_pose: PoseCommand,
            keys.command_joint: JointCommand,
            keys.command_gripper: GripperCommand,
            keys.task: Task,
            keys.sim_scene: SceneState,
            keys.sim_objects: ObjectPoses,
        }

    def of(self, key: str) -> type | None:
        """The record type of `key`; None for images, plain text and unknown keys."""
        if key not in self._known:
            self._known[key] = self._look_up(key)
        return self._known[key]

    def _look_up(self, key: str) -> type | None:
        families = (
            (self._keys.delta, ActionChunk),
            (self._keys.spec, ModelSpec),
            (self._keys.status, NodeStatus),
            (self._keys.event, Event),
            (self._keys.seen_record, InferenceDebug),
        )
        name = last_chunk(key)
        part, _, rest = self._keys.short(key).partition("/")
        of_part = self._keys.full(rest)
        if part not in NOT_PARTS and of_part in self._of_parts:
            return self._known[of_part]
        try:
            return next((kind for make, kind in families if make(name) == key), None)
        except ProfileError:
            return None
