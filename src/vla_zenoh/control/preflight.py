"""Preflight: all reasons against an activation, reported at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vla_zenoh.control import policy_check
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import BEGIN_JOINT, BEGIN_M, BEGIN_RAD, into_workspace
from vla_zenoh.errors import RecordError, SpecError, VlaZenohError
from vla_zenoh.keys import LOADING, NO_TASK, NOTHING_YET, OPENING, worker_node
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, held_pose, pose_distance, pose_of
from vla_zenoh.policy import ModelSpec, check_steps
from vla_zenoh.profile import Profile
from vla_zenoh.types import (
    ActionChunk,
    FloatArray,
    GripperState,
    JointBound,
    JointState,
    PoseState,
    Stamped,
)

CHUNK_PATIENCE_S = 2.0
"""Every worker publishes chunks all the time; its newest may be this old, plus one period."""
CLOCK_TOLERANCE_S = 0.02
"""A state may be stamped this far in the future before clocks count as different."""
CAMERA_PATIENCE_S = 1.0
"""Slower than any camera that a model can use, and what a status is late by."""
FIRST_REAL_NS = 10**18
"""Stamps before this (2001) are no time of day."""
JOINT_PATIENCE_S = 0.1
"""Beside ``state_timeout_s``: some robots report joints less often than poses."""
SAME_TCP_M, SAME_TCP_RAD = 0.005, 0.02
"""Two measurements of one TCP differ by this at most."""
HELD = JointBound(0.1, 0.03)
"""Largest distance of a joint from where its controller holds it."""
SETTLED, SETTLED_NS = 5e-4, 100_000_000
"""A robot that moves by less than this, in m and rad, for this long stands."""
LINGER_NS = 500_000_000
"""The stream continues for this long after the arm stands, so that its last pose is not lost."""


@dataclass(frozen=True, slots=True)
class PeerSnapshot:
    """What the command node knows about the other nodes.

    Args:
        alive: names of the nodes that have a liveliness token.
        robot_node: the node that drives the robot.
        specs: worker -> its newest spec.
        spec_sources: worker -> source of that spec, the only one whose chunks count.
        worker_complaints: worker -> why it cannot infer, by its status.
        camera_ages_s: camera -> age of its newest image, by its node's status.
        camera_nodes: camera -> the node that serves it.
        hosts: node -> its host, by its status.
        same_host: nodes that certainly run on the command node's host and share its clock.
        clocks: node -> its clock minus that of the command node and how uncertain that is, s, where
            measured.
        holders: clients present as a deadman.
        camera_reasons: camera -> why it sends no images, by its node's status.
        camera_faults: camera -> why its images are invalid, by its node's status: the rest of a
            sentence that starts with ``camera NAME``.
        down: node of the profile that does not run -> why, by `vla-zenoh up` of its host.
    """

    alive: frozenset[str] = frozenset()
    robot_node: str = "sim"
    specs: Mapping[str, ModelSpec] = field(default_factory=dict)
    spec_sources: Mapping[str, str] = field(default_factory=dict)
    worker_complaints: Mapping[str, str] = field(default_factory=dict)
    camera_ages_s: Mapping[str, float] = field(default_factory=dict)
    camera_nodes: Mapping[str, str] = field(default_factory=dict)
    hosts: Mapping[str, str] = field(default_factory=dict)
    same_host: frozenset[str] = frozenset()
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    holders: frozenset[str] = frozenset()
    camera_faults: Mapping[str, str] = field(default_factory=dict)
    camera_reasons: Mapping[str, str] = field(default_factory=dict)
    down: Mapping[str, str] = field(default_factory=dict)

    def why_down(self, node: str) -> str:
        """``: REASON``, to end a sentence about a node that is not alive; empty if unknown."""
        why = self.down.get(node)
        return f": {why}" if why else ""

    def uncertainty_s(self, node: str) -> float:
        """By how much stamps of a node may be wrong on our clock."""
        return 0.0 if node in self.same_host else self.clocks.get(node, (0.0, 0.0))[1]


STARTS = (LOADING, NO_TASK, NOTHING_YET)
"""Beginnings of what a worker complains of while it starts."""


class Passing(str):
    """A reason that passes by itself: something is starting."""

    __slots__ = ()


def reasons_of_part(
    profile: Profile,
    peers: PeerSnapshot,
    pose: Stamped[PoseState] | None,
    gripper: Stamped[GripperState] | None,
    now_ns: int,
) -> list[str]:
    """Reasons against an activation that are about one arm and gripper, as sentences.

    `now_ns`, here and below, is on the clock of the records' ``received_ns``.
    """
    if peers.robot_node not in peers.alive:
        why_down = peers.why_down(peers.robot_node)
        gone = f"the robot's node {peers.robot_node!r} is not alive{why_down}"
        return [*_guesses(profile), gone]
    reasons = [*_guesses(profile), *_robot(profile, peers, pose, now_ns)]
    if gripper is None:
        return [*reasons, Passing("the gripper is not known: nothing received on state/gripper")]
    if profile.robot.gripper is not None and gripper.record.width_m is None:
        reasons.append(
            "the robot reports no gripper, and the profile declares one: set robot.gripper: null "
            "(and finger_joints: []) if it has none"
        )
    lost = state_lost("gripper", gripper, profile.timing.state_timeout_s, now_ns)
    return [*reasons, *filter(None, (lost, why_not_ready(gripper.record)))]


def reasons_of_worker(
    profile: Profile,
    worker: str,
    prompt: str,
    peers: PeerSnapshot,
    chunk: Stamped[ActionChunk] | None,
    now_ns: int,
    rate_hz: float,
) -> list[str]:
    """Those that are about the worker that gets the lease, for all parts of a robot.

    Args:
        profile: the effective profile.
        worker: its name.
        prompt: the prompt in force.
        peers: the other nodes.
        chunk: the worker's newest, published without the lease.
        now_ns: time of this tick.
        rate_hz: chunks per second requested of the worker.
    """
    spec = peers.specs.get(worker)
    reasons = _worker(worker, prompt, peers, spec)
    if spec is not None:
        reasons += [
            f"worker {worker!r} {why}" if name == "camera" else f"worker {worker!r}: {name}: {why}"
            for _, name, why in policy_check.spec_errors(profile, spec)
        ]
        if why := policy_check.wrong_rate(spec, rate_hz):
            reasons.append(f"worker {worker!r}: {why}")
        reasons += _chunk(profile, worker, spec, peers, chunk, now_ns, rate_hz)
        reasons += _cameras(profile, spec, peers)
    return [*reasons, *_clocks(profile, worker, spec, peers)]


def reasons_by_joints(
    profile: Profile,
    worker: str,
    spec: ModelSpec,
    chunk: ActionChunk,
    bounds: JointBounds,
    joint: Stamped[JointState],
) -> list[str]:
    """Reasons against a worker whose newest chunk is not for the joints of this arm."""
    kinematics = bounds.kinematics
    try:
        joints_rad = kinematics.joints_of(joint.record)
        action = spec.action.of(profile.part)
        steps = check_steps(spec.action, chunk.steps)[:, spec.action.columns(profile.part)]
        here, jacobian = kinematics.pose_and_jacobian(joints_rad)
        axes = policy_check.beyond_joints(action, steps, jacobian, here.rotation)
    except (RecordError, SpecError):
        return []  # there is a reason for it already
    found = policy_check.joints_as_pose(
        action, steps, joints_rad, kinematics.slides, profile.limits
    )
    slides = np.isin(action.joints, np.array(kinematics.arm_joints)[kinematics.slides])
    if slides.any():  # else it is known by now
        beyond = policy_check.beyond_joint_units(action, steps, profile.limits, slides)
        found += [] if beyond is None else [policy_check.error("joint_units", beyond.why)]
    if action.targets and set(action.joints) == set(kinematics.arm_joints):
        given = bounds.in_chain_order(action, steps.astype(np.float64))
        far = bounds.far_out_of_range(action, given, joints_rad)
        found += [] if far is None else [policy_check.error("joint_limit", far.why)]
    reasons = [
        f"worker {worker!r}: its newest chunk is not sane: {name}: {why}" for _, name, why in found
    ]
    if axes:
        reasons.append(
            f"worker {worker!r} asks for motion that the {len(joints_rad)} joints of robot "
            f"{profile.robot.name!r} cannot make from here: {', '.join(axes)}; use a model or "
            "prompt that leaves out these axes, or move the arm"
        )
    return reasons


def joint_state_faults(
    profile: Profile,
    kinematics: Kinematics,
    joint: Stamped[JointState] | None,
    pose: Stamped[PoseState],
    now_ns: int,
) -> list[str]:
    """Whether the kinematics fit this robot: joints are received, their TCP is the reported one."""
    if joint is None:
        return ["the joints are not known: nothing received on state/joint"]
    most_s = profile.timing.state_timeout_s + JOINT_PATIENCE_S
    why = state_lost("joints", joint, most_s, now_ns)
    if why:
        return [why]
    try:
        joints_rad = kinematics.joints_of(joint.record)
    except VlaZenohError as error:
        return [str(error)]
    apart_m, apart_rad = pose_distance(kinematics.forward(joints_rad), pose_of(pose.record))
    if apart_m <= SAME_TCP_M and apart_rad <= SAME_TCP_RAD:
        return _elbow_is_not_held(profile, kinematics, joint.record, pose.record)
    return [
        f"the joints put the TCP {apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad from where "
        "the robot reports it: robot.description or robot.tcp_frame is another robot's"
    ]


def _elbow_is_not_held(
    profile: Profile, kinematics: Kinematics, joint: JointState, pose: PoseState
) -> list[str]:
    """Whether joint commands would begin far from the measured joints.

    They begin where the robot's controller holds the joints. If the TCP is far from there the arm
    is blocked, and retreats with all its joints; otherwise only the elbow was moved, and would be
    pulled back.
    """
    if profile.robot.command != "joint" or joint.reference_rad is None:
        return []
    apart_m, apart_rad = pose_distance(held_pose(pose), pose_of(pose))
    if apart_m > profile.limits.tracking_m or apart_rad > profile.limits.tracking_rad:
        return []
    away_rad = np.abs(held_joints(kinematics, joint) - kinematics.joints_of(joint))
    most = HELD.of(kinematics.slides)
    worst = int(np.argmax(away_rad / most))
    if away_rad[worst] <= most[worst]:
        return []
    return [
        f"joint {kinematics.arm_joints[worst]} is {away_rad[worst]:.2f} {kinematics.unit(worst)} "
        f"from where its controller holds it, at most {most[worst]:g}: release the arm, or move "
        "the robot once by its own means"
    ]


def clock_remedy(stamp_ns: int, profile: Profile) -> str:
    """What to do about a robot's stamps that are not of this clock."""
    if stamp_ns < FIRST_REAL_NS and profile.ros2 is not None:
        return (
            f"they look like simulated time ({stamp_ns / 1e9:.1f} s after its beginning): set "
            "ros2.use_sim_time: true"
        )
    return "synchronise the clocks of both hosts (chrony or ptp)"


def _guesses(profile: Profile) -> list[str]:
    if profile.robot.driver == "sim" or not profile.unconfirmed:
        return []
    return [
        f"guessed and not confirmed: {', '.join(profile.unconfirmed)}; look at each in the "
        "profile, correct it, and delete it from unconfirmed"
    ]


def _robot(
    profile: Profile, peers: PeerSnapshot, pose: Stamped[PoseState] | None, now_ns: int
) -> list[str]:
    if pose is None:
        return [Passing("the TCP pose is not known: nothing received on state/pose")]
    reasons = _too_old("TCP pose", pose, profile, now_ns)
    delay_s = (pose.received_ns - pose.header.stamp_wall_ns) / 1e9
    tolerance_s = CLOCK_TOLERANCE_S + peers.uncertainty_s(peers.robot_node)
    if not -tolerance_s <= delay_s <= tolerance_s + profile.timing.state_timeout_s:
        reasons.append(
            f"the robot's clock and this one differ: its newest state arrived {delay_s:+.3f} s "
            f"after its stamp; {clock_remedy(pose.header.stamp_wall_ns, profile)}"
        )
    _, outside_m = into_workspace(profile.limits, pose.record.position_m)
    if outside_m > profile.limits.step_m:
        at = ", ".join(f"{value:.3f}" for value in pose.record.position_m)
        reasons.append(
            f"the TCP at ({at}) m is {outside_m:.3f} m outside the workspace "
            f"{profile.limits.tcp_box}; move it inside"
        )
    return reasons


STOP_LATCHED = "latched"
"""Mode of a robot whose node has heard a stop, until it hears a reset."""


def state_lost(name: str, state: Stamped[Any], most_s: float, now_ns: int) -> str:
    """Why a measured state is lost, empty while it arrives in time.

    Args:
        name: of the state.
        state: the newest.
        most_s: its greatest age, by its arrival and, with a tolerance for clocks, by its stamp.
        now_ns: on the clock of its arrival.
    """
    silent_s = (now_ns - state.received_ns) / 1e9
    if silent_s > most_s:
        return f"robot state lost: {name} {silent_s:.3f} s old, at most {most_s:g} s"
    late_s = (now_ns - state.header.stamp_wall_ns) / 1e9
    if late_s > most_s + CLOCK_TOLERANCE_S:
        late_s -= CLOCK_TOLERANCE_S
        return f"robot state comes late: {name} by {late_s:.3f} s, at most {most_s:g} s"
    if late_s < -most_s - CLOCK_TOLERANCE_S:
        return f"robot state is stamped {-late_s:.3f} s in the future: {name}"
    return ""


def why_not_ready(gripper: GripperState) -> str:
    """Faults that the robot reports, or the mode in which it takes no commands; empty if none."""
    if gripper.faults:
        return f"the robot reports: {'; '.join(gripper.faults)}"
    if gripper.mode == STOP_LATCHED:
        return "the robot node holds an emergency stop; `vla-zenoh reset` clears it"
    return "" if gripper.mode == "ready" else f"the robot is not ready but {gripper.mode!r}"


def _too_old(what: str, state: Stamped[Any], profile: Profile, now_ns: int) -> list[str]:
    age_s, limit_s = (now_ns - state.received_ns) / 1e9, profile.timing.state_timeout_s
    if age_s <= limit_s:
        return []
    return [f"the {what} is {age_s:.2f} s old, at most {limit_s:g} s is allowed"]


def _worker(worker: str, prompt: str, peers: PeerSnapshot, spec: ModelSpec | None) -> list[str]:
    node = worker_node(worker)
    if node not in peers.alive:
        others = sorted(
            name.removeprefix("worker-") for name in peers.alive if name.startswith("worker-")
        )
        alive = ", ".join(others) or "none"
        return [f"worker {worker!r} is not alive{peers.why_down(node)}; alive are: {alive}"]
    if spec is None:
        return [Passing(f"worker {worker!r} has not published its spec")]
    reasons: list[str] = []
    if spec.observation.prompt and not prompt:
        reasons.append(f"worker {worker!r} needs a prompt and there is none")
    complaint = peers.worker_complaints.get(worker)
    if complaint:
        why = f"worker {worker!r} reports: {complaint}"
        reasons.append(Passing(why) if complaint.startswith(STARTS) else why)
    return reasons


def _chunk(
    profile: Profile,
    worker: str,
    spec: ModelSpec,
    peers: PeerSnapshot,
    chunk: Stamped[ActionChunk] | None,
    now_ns: int,
    rate_hz: float,
) -> list[str]:
    if worker_node(worker) not in peers.alive:
        return []
    oldest_s = profile.timing.max_observation_age_s
    patience_s = max(CHUNK_PATIENCE_S, oldest_s) + 1.0 / rate_hz
    # Chunks from before a restart of the worker do not count.
    ours = chunk is not None and chunk.header.source == peers.spec_sources.get(worker)
    if chunk is None or not ours or now_ns - chunk.received_ns > patience_s * 1e9:
        why = f"worker {worker!r} has published no chunk in the last {patience_s:g} s"
        return [why if ours else Passing(why)]  # else it has published none since its start
    if chunk.record.spec_hash != spec.hash:
        return [f"worker {worker!r} publishes chunks of another spec than its own"]
    delay_s = (chunk.received_ns - chunk.record.observation_stamp_ns) / 1e9
    if delay_s > oldest_s:
        return [
            f"worker {worker!r} is too slow: its newest chunk came {delay_s:.2f} s after its "
            f"observation, at most {oldest_s:g} s is allowed (timing.max_observation_age_s)"
        ]
    if delay_s < -CLOCK_TOLERANCE_S - peers.uncertainty_s(worker_node(worker)):
        return [
            f"the clocks of camera and command node differ: worker {worker!r} saw something "
            f"{-delay_s:.3f} s before it happened; synchronise them (chrony or ptp)"
        ]
    try:
        steps = check_steps(spec.action, chunk.record.steps)
    except SpecError as error:
        return [f"worker {worker!r}: its newest chunk is not sane: {error}"]
    try:
        found = [
            finding
            for part in profile.part_names
            for finding in policy_check.chunk_errors(
                spec.action.of(part),
                steps[:, spec.action.columns(part)],
                profile.of_part(part).limits,
                profile.of_part(part).robot.max_width_m,
            )
        ]
    except SpecError:
        return []  # reported with the spec
    return [
        f"worker {worker!r}: its newest chunk is not sane: {name}: {why}" for _, name, why in found
    ]


def _cameras(profile: Profile, spec: ModelSpec, peers: PeerSnapshot) -> list[str]:
    reasons: list[str] = []
    for camera in spec.observation.camera_names:
        if camera not in profile.cameras:
            continue  # reported already, with the spec
        age_s = peers.camera_ages_s.get(camera, math.inf)
        node = peers.camera_nodes.get(camera) or profile.camera_servers()[camera]
        why = peers.camera_reasons.get(camera)
        if node not in peers.alive:
            reasons.append(
                f"camera {camera!r}: its node {node!r} is not alive{peers.why_down(node)}; "
                "`vla-zenoh up` on its host starts it"
            )
        elif age_s > CAMERA_PATIENCE_S:
            since = "yet" if math.isinf(age_s) else f"for {age_s:.1f} s"
            sentence = f"camera {camera!r} has sent no image {since}: {why or 'it gives no reason'}"
            starts = math.isinf(age_s) and (not why or why.startswith(OPENING))
            reasons.append(Passing(sentence) if starts else sentence)
        elif camera in peers.camera_faults:
            reasons.append(f"camera {camera!r} {peers.camera_faults[camera]}")
    return reasons


def _clocks(
    profile: Profile, worker: str, spec: ModelSpec | None, peers: PeerSnapshot
) -> list[str]:
    """Clocks with too large an offset, or an unknown one on another host."""
    cameras = spec.observation.camera_names if spec is not None else ()
    nodes = [peers.robot_node, worker_node(worker)]
    nodes += [peers.camera_nodes[name] for name in cameras if name in peers.camera_nodes]
    bound_s, reasons = profile.timing.max_clock_offset_s, []
    for node in dict.fromkeys(nodes):
        offset_s, uncertainty_s = peers.clocks.get(node, (None, 0.0))
        # Within its uncertainty it is none: a slow link, or a busy computer, is no wrong clock.
        if offset_s is not None and abs(offset_s) > max(bound_s, uncertainty_s):
            reasons.append(
                f"the clock of node {node!r} is {offset_s:+.3f} s off this one's "
                f"(+-{uncertainty_s:.4f} s), at most {bound_s:g} s is allowed "
                "(timing.max_clock_offset_s); synchronise the clocks of both hosts (chrony or ptp)"
            )
        elif offset_s is None and node in peers.alive - peers.same_host:
            where = f" on {peers.hosts[node]}" if node in peers.hosts else ""
            why = f"the clock of node {node!r}{where} is not known: it has not answered yet"
            reasons.append(Passing(why))
    return reasons


def held_joints(kinematics: Kinematics, joint: JointState) -> FloatArray:
    """(n,) joint set-points of the robot's controller, or the measured joints."""
    if joint.reference_rad is not None:
        return kinematics.ordered(joint.names, joint.reference_rad)
    return kinematics.joints_of(joint)


def follows(apart_m: float, apart_rad: float) -> bool:
    """The robot holds the streamed pose: to restart there would be a step in the stream."""
    return apart_m <= BEGIN_M and apart_rad <= BEGIN_RAD


class Settling:
    """Whether the robot has come to the end of a stream that stands.

    Args:
        kinematics: of the arm, where joints are commanded.
    """

    def __init__(self, kinematics: Kinematics | None) -> None:
        self._kinematics = kinematics
        self._standing: tuple[Pose, FloatArray | None, int] | None = None
        self._measured_ns = 0

    def restart(self) -> None:
        """The stream moves."""
        self._standing = None

    def measure(self, measured: PoseState, joint: JointState | None, received_ns: int) -> None:
        """Track whether the robot moves; a record that is repeated does not show that it stands."""
        held, held_rad = held_pose(measured), None
        if self._kinematics is not None and joint is not None:
            held_rad = held_joints(self._kinematics, joint)
        before, before_rad, _ = self._standing or (held, held_rad, received_ns)
        moved = max(*pose_distance(held, before), *_ways(held_rad, before_rad)) > SETTLED
        if self._standing is None or moved:
            self._standing = held, held_rad, received_ns
        self._measured_ns = received_ns

    def unsettled(self, commanded: Pose, commanded_rad: FloatArray | None) -> list[str]:
        """Reasons against an activation now: the robot still moves to the end of the stream.

        A robot that has braked by itself stands elsewhere: a new stream begins there.
        """
        if self._standing is None:
            return []
        held, held_rad, since_ns = self._standing
        apart, ways, joints = pose_distance(held, commanded), _ways(held_rad, commanded_rad), ""
        near = follows(*apart)
        if self._kinematics is not None and len(ways):
            most = BEGIN_JOINT.of(self._kinematics.slides)
            worst = int(np.argmax(ways / most))
            near = near and bool(ways[worst] <= most[worst])
            joints = f", its joints {ways[worst]:.3f} {self._kinematics.unit(worst)}"
        if near or self._measured_ns - since_ns > SETTLED_NS:
            return []
        return [
            f"the robot is still {apart[0]:.3f} m and {apart[1]:.3f} rad from its last "
            f"command{joints}; activate again in {LINGER_NS / 1e9:g} s"
        ]


def _ways(joints_rad: FloatArray | None, others_rad: FloatArray | None) -> FloatArray:
    """(n,) how far each joint is from another place; (0,) where one of them is not known."""
    if joints_rad is None or others_rad is None:
        return np.zeros(0)
    return np.abs(joints_rad - others_rad)
