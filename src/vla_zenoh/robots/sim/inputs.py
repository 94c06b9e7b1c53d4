"""What the simulated robot takes in at every tick: poses, joint positions, widths, resets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import settings
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.guard.arm_guard import ArmGuard
from vla_zenoh.guard.gripper_guard import GripperGuard
from vla_zenoh.simulation.world import World
from vla_zenoh.types import GripperCommand, JointCommand, PoseCommand, Stamped

LEAST_FORCE_N = 0.1
"""A gripper told to press with nothing would not move."""

Command = TypeVar("Command", PoseCommand, JointCommand)


class SimInputs:
    """Listens to who commands the arm.

    Args:
        node: the sim node; it counts and tells what is refused.
        world: its gripper is moved.
        guard: judges the streams of poses and joint positions.
        reset: called with a seed, None for the profile's own.
        lockstep: nobody's clock but the world's counts.
    """

    def __init__(
        self,
        node: Node,
        world: World,
        guard: ArmGuard,
        reset: Callable[[int | None], None],
        *,
        lockstep: bool,
    ) -> None:
        self._node, self._world, self._guard = node, world, guard
        self._reset, self._lockstep = reset, lockstep
        keys = node.keys
        self._poses = node.subscribe(keys.command_pose, CallbackRing(64, SMALL_BYTES))
        self._joints = node.subscribe(keys.command_joint, CallbackRing(64, SMALL_BYTES))
        self._widths = node.subscribe(keys.command_gripper, CallbackRing(16, SMALL_BYTES))
        self._resets = node.subscribe(keys.sim_reset, CallbackRing(4, settings.MAX_SETTING_BYTES))
        self._gripper_guard = GripperGuard(node.profile.robot.gripper)

    def take(self, now_ns: int) -> None:
        """Obey or refuse what came since the last call."""
        for arrival in self._poses.drain():
            pose = self._node.decode(PoseCommand, arrival)
            if pose is not None:
                self._offer(pose, self._guard.offer_pose, "pose", now_ns)
        for arrival in self._joints.drain():
            joints = self._node.decode(JointCommand, arrival)
            if joints is not None:
                self._offer(joints, self._guard.offer_joint, "joint", now_ns)
        for arrival in self._widths.drain():
            width = self._node.decode(GripperCommand, arrival)
            if width is not None:
                self._take_width(width, now_ns)
        for arrival in self._resets.drain():
            seed = self._node.decode_text(_seed_or_default, arrival)
            if seed is not None:
                self._reset(seed.value)

    def _offer(
        self,
        command: Stamped[Command],
        take: Callable[[Stamped[Command], int], str | None],
        mode: str,
        now_ns: int,
    ) -> None:
        if self._lockstep:
            command = replace(command, received_ns=now_ns)
        reason = take(command, now_ns)
        if reason is not None:
            self._node.reject(
                f"{mode}_{reason}", f"command/{mode} by {command.header.source[:60]!r}: {reason}"
            )

    def _take_width(self, width: Stamped[GripperCommand], now_ns: int) -> None:
        if self._lockstep:  # its clock is nobody else's: nothing has an age
            now_ns = width.header.stamp_wall_ns
        try:
            order = self._gripper_guard.accept(
                width, self._guard.writer, now_ns, writer_active=self._guard.writer_active
            )
        except CodecError as error:
            self._node.reject(error.reason, f"command/gripper {error}")
            return
        self._node.counters["gripper_bounded"] = self._gripper_guard.bounded
        self._world.set_gripper(order.width_m, order.speed_m_s, max(order.force_n, LEAST_FORCE_N))


@dataclass(frozen=True, slots=True)
class _Seed:
    """A seed, or None for the profile's own."""

    value: int | None


def _seed_or_default(payload: bytes) -> _Seed:
    return _Seed(settings.decode_seed(payload))
