"""What is told of an arm of one's own: its states on their keys, a fault at once."""

from __future__ import annotations

from dataclasses import replace

from vla_zenoh.bus.node import Node
from vla_zenoh.interop.python_reading import ValidReading
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation
from vla_zenoh.types import FloatArray, GripperState

FAULT_AGAIN_NS = 100_000_000
"""A fault without states is said again after this, for who was started meanwhile."""


class ArmStates:
    """Writes ``state/joint``, ``state/pose`` and ``state/gripper``.

    Args:
        node: on whose behalf.
    """

    def __init__(self, node: Node) -> None:
        self._clock = node.clock
        self._joint_out = node.declare_publisher(node.keys.state_joint, Kind.STATE)
        self._pose_out = node.declare_publisher(node.keys.state_pose, Kind.STATE)
        self._gripper_out = node.declare_publisher(node.keys.state_gripper, Kind.STATE)
        # A little less than the period: who asks comes at multiples of another one.
        self._period_ns = 0.9e9 / node.profile.timing.state_hz
        self._seq = self._put_ns = 0
        self._fault = ""

    def tell(
        self,
        taken: ValidReading,
        held: tuple[Pose | None, FloatArray | None],
        mode: str,
        fault: str,
        mono_ns: int,
    ) -> None:
        """Tell a new reading, where it is time or a fault came or went.

        Args:
            taken: the reading.
            held: where the robot's controller holds the TCP, and (n,) its joints; see `Lead.held`.
            mode: the robot's, in a word.
            fault: why it does not move.
            mono_ns: now, on the monotonic clock.
        """
        if fault == self._fault and mono_ns - self._put_ns < self._period_ns:
            return
        pose, joints = taken.pose, taken.joints
        tcp, angles_rad = held
        if tcp is not None:
            pose = replace(
                pose,
                reference_position_m=tcp.position_m,
                reference_quat_xyzw=quat_from_rotation(tcp.rotation),
            )
        if angles_rad is not None:
            joints = replace(joints, reference_rad=angles_rad)
        self._joint_out.publish(joints, stamp_wall_ns=taken.stamp_ns, seq=self._seq)
        self._pose_out.publish(pose, stamp_wall_ns=taken.stamp_ns, seq=self._seq)
        self._tell_gripper(taken.gripper, taken.stamp_ns, mode, fault, mono_ns)

    def tell_fault(self, gripper: GripperState, mode: str, fault: str, mono_ns: int) -> None:
        """Tell that a fault came, stands or went, where no reading can be told with it.

        The number of joints and pose that were not told is passed over.
        """
        again = bool(fault) and mono_ns - self._put_ns >= FAULT_AGAIN_NS
        if fault != self._fault or again:
            self._tell_gripper(gripper, self._clock.wall_at(mono_ns), mode, fault, mono_ns)

    def _tell_gripper(
        self, gripper: GripperState, stamp_ns: int, mode: str, fault: str, mono_ns: int
    ) -> None:
        record = replace(gripper, mode=mode, faults=(fault,) if fault else ())
        self._gripper_out.publish(record, stamp_wall_ns=stamp_ns, seq=self._seq)
        self._seq += 1
        self._put_ns, self._fault = mono_ns, fault
