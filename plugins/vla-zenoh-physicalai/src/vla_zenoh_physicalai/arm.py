"""A robot behind an owner process of Intel's physicalai, driven by joint targets.

An owner holds its last target for ever and follows whoever puts an action. So the node's own
watchdog brakes the arm before it, and an action of anyone else is a fault.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.errors import CodecError, NodeError, VlaZenohError
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh_physicalai import link, wire
from vla_zenoh_physicalai.layout import UNIT_OF, Layout
from vla_zenoh_physicalai.plugin import PhysicalAiOptions

METADATA_S, LOST_S = 5.0, 1.0
"""An owner that starts replies within the first; without a valid state it is lost after the
second."""
OTHERS_S = 1.0
"""How long after the last action of somebody else the arm is not ours."""
STILL, HELD, STILL_S = 0.01, 0.04, 0.3
"""The gripper stands if it moved by less, and holds an object if it is open wider than commanded by
this much; both of its largest width."""


class PhysicalAiArm:
    """The arm of a profile with a section physicalai; see `vla_zenoh.robot.Robot`."""

    def __init__(self, profile: Profile, options: PhysicalAiOptions) -> None:
        self._profile, self._options = profile, options
        self._where = options.endpoint or wire.local_endpoint(options.name)
        self._goal_time_s = 1.0 / profile.timing.command_hz
        if options.gripper:
            profile.robot.require_gripper(f"physicalai.gripper {options.gripper!r}")
        self._width_range_m = profile.robot.max_width_m
        self._session: zenoh.Session | None = None
        self._rejected, self._complaint = 0, ""
        self._read_s = self._others_s = 0.0
        self._stamp_s = float("-inf")
        self._measured: tuple[FloatArray, float | None] | None = None
        self._last_rad: FloatArray | None = None
        """The last commanded joints; None: the owner does not hold those."""
        self._asked_m: float | None = None
        self._grip_was_m, self._grip_moved_s = 0.0, 0.0
        if not options.gripper:
            vars(self)["grip"] = None  # commands of the gripper are rejected then

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Find the owner and its robot's joints, or raise a `NodeError`; nothing moves."""
        name = self._options.name
        try:
            session = self._session = link.open_session("client", connect=self._where)
        except zenoh.ZError as error:
            raise NodeError(
                f"no owner of {name!r} at {self._where}: start it with `physicalai robot serve`, "
                f"or set physicalai.endpoint ({error})"
            ) from error
        self._robot = self._ask()
        self._layout = self._layout_of(self._robot)
        self._states = link.subscribe(session, name, "state")
        self._others = link.subscribe(session, name, "action")
        self._actions = link.declare_publisher(session, name, "action")
        self._read_s = time.monotonic()

    def _ask(self) -> wire.Metadata:
        assert self._session is not None
        key, until_s = wire.key(self._options.name, "metadata"), time.monotonic() + METADATA_S
        while time.monotonic() < until_s:
            for reply in self._session.get(key, timeout=1.0):
                if reply.ok is not None:
                    try:
                        return wire.decode_metadata(bytes_of(reply.ok.payload, wire.MAX_BYTES))
                    except CodecError as error:
                        raise NodeError(f"metadata of {self._options.name!r}: {error}") from error
            time.sleep(0.1)
        raise NodeError(f"nobody at {self._where} replies to {key}: does it own another robot?")

    def _layout_of(self, robot: wire.Metadata) -> Layout:
        options = self._options
        unit = UNIT_OF.get(robot.robot_class)
        if options.units and unit not in (None, options.units):
            raise NodeError(
                f"physicalai.units is {options.units}, but {robot.robot_class} has {unit}"
            )
        unit = options.units or unit
        if not unit:
            raise NodeError(
                f"the unit of {robot.robot_class}'s joints is not known: set physicalai.units"
            )
        shut, opened = options.gripper_shut, options.gripper_open
        if unit == "normalised":
            shut, opened = 0.0 if shut is None else shut, 100.0 if opened is None else opened
        if options.gripper and (shut is None or opened is None):
            raise NodeError(
                f"{robot.robot_class}: set physicalai.gripper_shut and physicalai.gripper_open, "
                f"its numbers of {options.gripper!r}"
            )
        try:
            return Layout(
                self._profile,
                robot.joint_names,
                unit,
                joints=options.joints or self._profile.robot.arm_joints,
                reversed=options.reversed,
                zero=options.zero,
                gripper=options.gripper,
                gripper_ends=(shut or 0.0, opened or 0.0),
            )
        except VlaZenohError as error:
            raise NodeError(f"robot {options.name!r}: {error}") from error

    def close(self) -> None:
        """End the session; the owner's robot holds its last target."""
        if self._session is not None:
            self._session.close()

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading | None:
        """The newest valid state; a `NodeError` if there was none for too long."""
        now_s = time.monotonic()
        if self._others.try_recv() is not None:
            self._others_s, self._last_rad, self._asked_m = now_s, None, None
        measured = self._newest()
        if measured is None:
            if now_s - self._read_s > LOST_S:
                words = self._complaint or "is its owner running?"
                raise NodeError(
                    f"no valid state of {self._options.name!r} for {LOST_S:g} s: {words}"
                )
            return None
        self._read_s, self._measured = now_s, measured
        position_rad, width_m = measured
        moving, holding = self._gripper(width_m, now_s)
        others = now_s - self._others_s < OTHERS_S
        key = wire.key(self._options.name, "action")
        return Reading(
            position_rad,
            width_m=width_m,
            moving=moving,
            holding=holding,
            fault=f"somebody else puts actions on {key}: end that" if others else "",
            measured_ns=None if self._options.endpoint else int(self._stamp_s * 1e9),
            idle=self._last_rad is None,
        )

    def _newest(self) -> tuple[FloatArray, float | None] | None:
        try:
            payload = link.newest(self._states)
            if payload is None:
                return None
            vector, stamp_s = wire.decode_state(payload, self._layout.count)
            if stamp_s <= self._stamp_s:
                raise CodecError("stale", f"timestamp {stamp_s:.3f} is not after the last one")
        except CodecError as error:
            self._rejected, self._complaint = self._rejected + 1, f"state: {error}"
            return None
        self._stamp_s, self._complaint = stamp_s, ""
        return self._layout.ours(vector)

    def _gripper(self, width_m: float | None, now_s: float) -> tuple[bool, bool]:
        """Whether it moves, and whether it holds something."""
        if width_m is None:
            return False, False
        if abs(width_m - self._grip_was_m) > STILL * self._width_range_m:
            self._grip_was_m, self._grip_moved_s = width_m, now_s
        moving = now_s - self._grip_moved_s < STILL_S
        asked_m = width_m if self._asked_m is None else self._asked_m
        return moving, not moving and width_m > asked_m + HELD * self._width_range_m

    def status(self) -> Mapping[str, Any]:
        """Which robot it is, and how many of its states were rejected."""
        complaint = {"complaint": self._complaint} if self._complaint else {}
        robot = self._robot
        said = {"physicalai": robot.name, "class": robot.robot_class, "host": robot.host}
        return {**said, "rejected_states": self._rejected, **complaint}

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Put the set-point as an action."""
        assert isinstance(command, JointCommand)
        self._last_rad = command.position_rad
        self._put(command.position_rad)

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Put the opening, and the joints as they were commanded; speed and force are its own."""
        if self._measured is None:
            raise NodeError("no state came yet")
        self._asked_m, self._grip_moved_s = width_m, time.monotonic()
        self._put(self._measured[0] if self._last_rad is None else self._last_rad)

    def _put(self, position_rad: FloatArray) -> None:
        if self._measured is None:
            raise NodeError("no state came yet")
        width_m = self._measured[1] if self._asked_m is None else self._asked_m
        self._asked_m = width_m  # the gripper stays where it was when the first command came
        targets = wire.array_of(self._layout.theirs(position_rad, width_m))
        self._actions.put(wire.encode(wire.Action(targets, self._goal_time_s, time.monotonic())))
