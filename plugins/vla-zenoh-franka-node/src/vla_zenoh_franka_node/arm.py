"""A Franka arm behind a franka-node, driven by targets under its lease.

The node has one session with the arm as long as ours has the lease: at rest it gets the last target
again, so states are those of its loop, 100 a second. Whoever ends that session, with the node's
``stop``, by its watchdog or a lost link, has stopped the arm: it stays so until a reset.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import rotation_from_quat
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh_franka_node import link, wire
from vla_zenoh_franka_node.bounds import Bounds, pose_values
from vla_zenoh_franka_node.hand import Hand, HandCommand
from vla_zenoh_franka_node.plugin import FrankaNodeOptions
from vla_zenoh_franka_node.steps import fault_of, is_stopped, mode_of, next_verb

CONNECT_S = 5.0
LOST_S, BUSY_S = 1.5, 6.0
"""Without a valid state the node is lost after this long; it publishes none while it stops."""
RETRY_S, SOON_S = 0.5, 0.05
"""A refused verb is tried again after the first; states are of after a verb after the second."""
KEEP_S = 0.05
"""At rest the last target is repeated after this long: below the node's hold_after_ms."""
REFUSED_S = 0.15
"""So long without a target that may be sent, or is accepted, is a fault."""


class FrankaNodeArm:
    """The arm of a profile with a section franka_node; see `vla_zenoh.robot.Robot`."""

    def __init__(self, profile: Profile, options: FrankaNodeOptions) -> None:
        self._profile, self._options = profile, options
        self._kinematics = make_kinematics(profile)
        self._kind: wire.Kind = "joints" if profile.robot.command == "joint" else "cartesian"
        self._bounds = Bounds(
            step_m=options.max_step_m,
            step_rad=options.max_step_rad,
            lead_m=options.max_lead_m,
            lead_rad=options.max_lead_rad,
            step_joint_rad=options.max_step_joint_rad,
            lead_joint_rad=options.max_lead_joint_rad,
        )
        self._client_id = secrets.randbelow(2**32 - 1) + 1
        self._session: zenoh.Session | None = None
        self._state: wire.State | None = None
        self._state_ns = 0
        self._hand = Hand() if options.hand else None
        if not options.hand:
            vars(self)["grip"] = None  # commands of the gripper are rejected then
        self._asked: link.Verb | None = None
        self._answer = self._episode = ""
        self._next_ask_s = 0.0
        self._recovering = False
        self._ended = ""
        """Why the session is not begun again; only `recover` ends that."""
        self._expected = self._ending = False
        """The session runs, and nobody has ended it that we know of; we are about to end it."""
        self._seq = self._hand_seq = 0
        self._sent: FloatArray | None = None
        self._sent_s = 0.0
        self._unsent_s: float | None = None
        """Since when no set-point was within the bounds; None: the last one was."""
        self._moved = False
        self._ee_of_tcp = np.eye(4)
        self._counts = {"refused": 0, "not_sent": 0, "rejected_states": 0}
        self._seen_refused = 0
        self._refusal = self._complaint = ""

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Find the arm, or raise a `NodeError`; nothing moves."""
        options = self._options
        try:
            session = self._session = link.open_session(options.endpoint)
        except link.ZError as error:
            raise NodeError(
                f"no franka-node or router at {options.endpoint}: "
                f"set franka_node.endpoint ({error})"
            ) from error
        self._states = link.Newest(session, wire.key(options.name, "state"))
        self._hands = link.Newest(session, wire.key(options.name, "gripper/state"))
        self._targets = link.declare_publisher(session, wire.key(options.name, "target"))
        self._grips = link.declare_publisher(session, wire.key(options.name, "gripper/target"))
        until_s = time.monotonic() + CONNECT_S
        while not self._take():
            if time.monotonic() > until_s:
                raise NodeError(
                    self._complaint
                    or f"no franka-node at {options.endpoint} has an arm {options.name!r}"
                )
            time.sleep(0.01)
        self._token = session.liveliness().declare_token(
            wire.key(options.name, f"lease/{self._client_id}")
        )

    def close(self) -> None:
        """End the session of the arm, and give the lease back."""
        session, state = self._session, self._state
        if session is None:
            return
        self._session, self._expected = None, False
        if state is not None and state.holder == self._client_id:
            for verb in ("stop", "release") if state.phase == "active" else ("release",):
                link.Verb(session, self._options.name, verb, self._request()).wait()
        session.close()

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading | None:
        """The newest state; also asks the node for what is due, and repeats the last target."""
        now_s, new = time.monotonic(), self._take()
        state = self._state
        assert state is not None
        self._check_link(state, now_s)
        if new:
            self._follow_session(state)
        self._ask_next(state, now_s)
        if self._expected and not self._ended and now_s - self._sent_s > KEEP_S:
            self._put(state.target if self._sent is None else self._sent, now_s)
        hand = self._read_hand(now_s)
        if not new:
            return None
        fault = fault_of(state) or self._ended
        if self._hand is not None and self._hand.newest is not None and self._hand.newest.fault:
            fault = fault or "hand: franka-node lost the gripper"
        mode = "" if fault else mode_of(state, self._client_id, self._answer)
        return Reading(
            state.position_rad,
            state.velocity_rad_s,
            state.effort_nm,
            **hand,
            wrench=-state.wrench if state.wrench.any() else None,
            fault=fault,
            mode=mode,
            measured_ns=self._state_ns,
            idle=not (self._expected and self._moved),
        )

    def _take(self) -> bool:
        """Whether a valid state has come, with a new measurement while a loop runs."""
        before = self._state
        try:
            arrived = self._states.take()
            if arrived is None:
                return False
            state = wire.decode_state(arrived.payload)
        except CodecError as error:
            self._counts["rejected_states"] += 1
            self._complaint = str(error)
            return False
        if (
            before is not None
            and state.phase == before.phase == "active"
            and state.robot_time_ms == before.robot_time_ms
        ):
            return False  # the loop hears nothing of the robot
        self._state, self._state_ns, self._complaint = state, arrived.at_ns, ""
        return True

    def _check_link(self, state: wire.State, now_s: float) -> None:
        age_s = now_s - self._state_ns / 1e9
        busy = self._asked is not None or state.phase == "stopping"
        if age_s > (BUSY_S if busy else LOST_S):
            why = self._complaint or "does it run, and is the link up?"
            raise NodeError(f"no new state of {self._options.name!r} for {age_s:.1f} s: {why}")

    def _follow_session(self, state: wire.State) -> None:
        """What became of our session, by a new state."""
        ours = state.phase == "active" and state.holder == self._client_id
        if not ours:
            if self._expected and not self._ending:
                self._end(
                    "franka-node ended the session: somebody asked it to stop, no target reached "
                    "it for its stop_after_ms, or our lease was lost"
                )
            self._expected = self._ending = False
            return
        if self._ending:
            return
        if not self._expected:
            self._begin(state)
        more = state.refused - self._seen_refused
        self._seen_refused = state.refused
        if more <= 0:
            return
        self._counts["refused"] += more
        before = state.target if self._sent is None else self._sent
        self._refusal = self._why_not(before, before) or "see its log with RUST_LOG=debug"
        if state.holding:
            self._end(f"franka-node refuses our targets: {self._refusal}")

    def _begin(self, state: wire.State) -> None:
        self._expected, self._moved, self._sent = True, False, None
        self._seen_refused, self._unsent_s, self._refusal = 0, None, ""
        names = self._profile.robot.arm_joints
        tcp = self._kinematics.forward(self._kinematics.ordered(names, state.position_rad))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = tcp.rotation, tcp.position_m
        self._ee_of_tcp = np.linalg.inv(pose) @ state.ee

    def _end(self, why: str) -> None:
        self._ended, self._ending = self._ended or why, True

    def _ask_next(self, state: wire.State, now_s: float) -> None:
        if self._asked is not None:
            outcome = self._asked.outcome()
            if outcome is None:
                return
            verb, self._asked = self._asked.verb, None
            self._answer = f"{verb}: {outcome}" if outcome else ""
            self._next_ask_s = now_s + (RETRY_S if outcome else SOON_S)
            if verb == "recover" and not outcome:
                self._recovering = False
            return
        if now_s < self._next_ask_s:
            return
        self._recovering = self._recovering and is_stopped(state)
        verb = next_verb(
            state,
            self._client_id,
            wanted=not (self._ended or self._ending or is_stopped(state)),
            recovering=self._recovering,
        )
        if not verb:
            return
        fields: dict[str, str] = {}
        if verb == "enable":
            self._episode = self._episode_name()
            fields = {"mode": self._kind, "episode": self._episode}
        assert self._session is not None
        self._asked = link.Verb(self._session, self._options.name, verb, self._request(**fields))

    def _episode_name(self) -> str:
        return f"{self._profile.robot.name}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"

    def _request(self, **fields: str) -> bytes:
        return wire.encode_request(self._client_id, **fields)

    def recover(self) -> None:
        """Clear the robot's errors, and begin the session again."""
        self._ended, self._recovering = "", True

    def status(self) -> Mapping[str, Any]:
        """The node's phase, holder and episode, and how many targets it refused."""
        state = self._state
        if state is None:
            return {}
        said = {
            "phase": state.phase,
            "robot_mode": state.robot_mode,
            "holder": state.holder,
            "client_id": self._client_id,
            "episode": self._episode,
            "control_command_success_rate": state.success_rate,
            "accepted": state.accepted,
            "dropped": state.dropped,
        }
        told = {"refusal": self._refusal, "complaint": self._complaint}
        return {**said, **self._counts, **{name: why for name, why in told.items() if why}}

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Send the set-point as a target, if it is within the bounds."""
        if not self._expected or self._ended:
            return
        if isinstance(command, JointCommand):
            values = command.position_rad
        else:
            pose = np.eye(4)
            pose[:3, :3] = rotation_from_quat(command.quat_xyzw)
            pose[:3, 3] = command.position_m
            values = pose_values(pose @ self._ee_of_tcp)
        self._moved = True
        self._send(values, time.monotonic())

    def _send(self, values: FloatArray, now_s: float) -> None:
        state = self._state
        assert state is not None
        why = self._why_not(values, state.target if self._sent is None else self._sent)
        if not why:
            self._unsent_s = None
            self._put(values, now_s)
            return
        self._counts["not_sent"] += 1
        self._refusal = why
        if self._unsent_s is None:
            self._unsent_s = now_s
        if now_s - self._unsent_s > REFUSED_S:
            self._end(why)

    def _why_not(self, values: FloatArray, before: FloatArray) -> str:
        state = self._state
        assert state is not None
        if self._kind == "joints":
            return self._bounds.why_not_joints(values, before, state.position_rad)
        return self._bounds.why_not_pose(values, before, state.ee)

    def _put(self, values: FloatArray, now_s: float) -> None:
        self._seq += 1
        self._sent, self._sent_s = values, now_s
        self._targets.put(
            wire.encode_target(self._kind, self._client_id, self._seq, time.monotonic_ns(), values)
        )

    # -- gripper ------------------------------------------------------------------------------
    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Open or close the fingers; their speed is the node's setting."""
        assert self._hand is not None
        self._command_hand(self._hand.ask(width_m, force_n, time.monotonic()))

    def _read_hand(self, now_s: float) -> dict[str, Any]:
        hand = self._hand
        if hand is None:
            return {}
        try:
            arrived = self._hands.take()
            if arrived is not None:
                hand.newest = wire.decode_gripper_state(arrived.payload)
        except CodecError as error:
            self._complaint = str(error)
        if hand.newest is None:
            return {}
        more = hand.follow_up(now_s)
        if more is not None:
            self._command_hand(more)
        moving, holding = hand.moving(now_s), hand.holding(now_s)
        return {"width_m": hand.newest.width_m, "moving": moving, "holding": holding}

    def _command_hand(self, command: HandCommand) -> None:
        self._hand_seq += 1
        self._grips.put(
            wire.encode_gripper(
                command.kind,
                self._client_id,
                self._hand_seq,
                time.monotonic_ns(),
                command.width_m,
                command.force_n,
            )
        )
