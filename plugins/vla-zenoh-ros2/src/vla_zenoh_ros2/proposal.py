"""What a profile may use of a ROS domain: commands of the arm and its gripper, states, cameras.

Topics do not say what they mean: what a name and a type only suggest is a guess, and said so.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from vla_zenoh.profile.robot import GRIPPER_ACTIONS
from vla_zenoh_ros2.pictures import COMPRESSED_IMAGE, IMAGE
from vla_zenoh_ros2.readers import JOINT_STATE
from vla_zenoh_ros2.ros_names import RosDomain
from vla_zenoh_ros2.writers import (
    GRASP,
    GRIPPER_MESSAGE,
    MOVE,
    NUMBER,
    NUMBERS,
    POSE_STAMPED,
    TRAJECTORY,
)

GOAL = "multi_mode_control_msgs/msg/CartesianImpedanceGoal"
ARM_COMMANDS = (TRAJECTORY, NUMBERS, GOAL, POSE_STAMPED)
"""Types that command an arm, the clearest first: a trajectory names its joints."""
GRIPPER_TOPICS = (GRIPPER_MESSAGE, TRAJECTORY, NUMBER, NUMBERS)
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
"""What a joint_trajectory_controller publishes beside its topic of trajectories while active."""
GRIPPER = re.compile(r"gripper|finger|hand|jaw|claw|grip|pinch", re.IGNORECASE)
NO_ARM = re.compile(r"initial_?pose|goal_pose|clicked|velocity|effort|torque|(^|_)vel(_|$)", re.I)
"""Of topics whose type is one of `ARM_COMMANDS` and that do not take positions of an arm."""
NO_COLOURS = re.compile(r"depth|infra|(^|/)ir(/|_|$)|mask|debug|theora|annotated|detect", re.I)
OF_EVERY_CAMERA = re.compile(
    r"image|raw|rect|colou?r|rgb|compressed|mono|image_(raw|rect|color|mono)|image_rect_(raw|color)"
)
SIMULATED_S = 3600.0
"""Stamps further from this clock are simulated time."""

SLOW_HZ, LATE_STATES = 20.0, 3
"""Slower joint states are too old at times; so many in a row may be late."""


class Topic(NamedTuple):
    """A topic, or an action, and its type."""

    name: str
    type: str


class HeardJoints(NamedTuple):
    """What was heard of joint states on a topic.

    Args:
        rate_hz: of messages.
        position: joint -> where it is, rad or m.
        behind_s: how far its stamps are behind this computer's clock.
    """

    rate_hz: float
    position: Mapping[str, float]
    behind_s: float


class HeardImages(NamedTuple):
    """What was heard of a camera: pixels and rate."""

    width: int
    height: int
    rate_hz: float


class DescribedArm(NamedTuple):
    """What a description says: joints of arm and fingers.

    Args:
        joints: of the arm, in the order of its chain.
        fingers: finger joints; empty: there are none.
        gripper: section ``robot.gripper``; empty: there is none.
    """

    joints: Sequence[str]
    fingers: Sequence[str]
    gripper: Mapping[str, float]


class Proposal(NamedTuple):
    """Parts of a profile.

    Args:
        section: ``ros2``.
        command: ``joint`` or ``pose``.
        cameras: section.
        guesses: (place in the profile, what it rests on).
        notes: what was found, as sentences.
    """

    section: Mapping[str, Any]
    command: str
    cameras: Mapping[str, Mapping[str, Any]]
    guesses: Sequence[tuple[str, str]]
    notes: Sequence[str]


# -- what there is --------------------------------------------------------------------------------
def below(namespace: str, names: Mapping[str, str], kinds: Iterable[str]) -> list[Topic]:
    """Those of these types in a namespace; of the whole domain if it has none."""
    kinds = (*kinds,)
    found = [Topic(name, kind) for name, kind in sorted(names.items()) if kind in kinds]
    return [each for each in found if each.name.startswith(f"{namespace}/")] or found


def state_topics(domain: RosDomain, namespace: str) -> list[str]:
    """Topics of joint states, ``joint_states`` itself first."""
    names = [each.name for each in below(namespace, domain.published, [JOINT_STATE])]
    return sorted(names, key=lambda name: (not name.endswith("/joint_states"), len(name), name))


def controller_states(domain: RosDomain, namespace: str) -> dict[str, str]:
    """Topic of trajectories -> that of the state of its controller."""
    states = {
        each.name: f"{each.name.rpartition('/')[0]}/controller_state"
        for each in arm_commands(domain, namespace)
        if each.type == TRAJECTORY
    }
    return {
        name: state
        for name, state in states.items()
        if domain.published.get(state) == CONTROLLER_STATE
    }


def arm_commands(
    domain: RosDomain,
    namespace: str,
    joints: Sequence[str] = (),
    controllers: Mapping[str, Sequence[str]] = {},
) -> list[Topic]:
    """Topics that may command the arm, the likeliest first.

    Args:
        joints: of the arm.
        controllers: topic -> joints that its controller says it moves; none: it says nothing.
    """
    found = below(namespace, domain.subscribed, ARM_COMMANDS)
    found = [each for each in found if not NO_ARM.search(each.name)]
    found = [each for each in found if not GRIPPER.search(each.name)]

    def rank(topic: Topic) -> tuple[int, int, int]:
        moved = controllers.get(topic.name)
        likely = 1 if moved is None else 0 if {*moved} == {*joints} else 2
        return likely, ARM_COMMANDS.index(topic.type), len(topic.name)

    return sorted(found, key=rank)


def gripper_commands(domain: RosDomain, namespace: str) -> list[Topic]:
    """Actions and topics that may command the gripper, the likeliest first."""
    reached = {name: kind for name, kind in domain.actions.items() if name not in domain.unreached}
    actions = below(namespace, reached, GRIPPER_ACTIONS)
    actions.sort(key=lambda each: (GRIPPER_ACTIONS.index(each.type), each.name))
    topics = below(namespace, domain.subscribed, GRIPPER_TOPICS)
    topics = [each for each in topics if GRIPPER.search(each.name)]
    topics.sort(key=lambda each: (GRIPPER_TOPICS.index(each.type), each.name))
    return [*actions, *topics]


def camera_topics(domain: RosDomain, namespace: str) -> dict[str, Topic]:
    """Name of a camera -> its topic of colour images, raw where there are both."""
    found: dict[str, Topic] = {}
    topics = below(namespace, domain.published, (IMAGE, COMPRESSED_IMAGE))
    for topic in sorted(topics, key=lambda each: (each.type != IMAGE, each.name)):
        raw = Topic(topic.name.removesuffix("/compressed"), IMAGE)
        if NO_COLOURS.search(topic.name) or (topic != raw and raw in topics):
            continue
        words = topic.name.removeprefix(namespace).strip("/").lower().split("/")
        own = [word for word in words if not OF_EVERY_CAMERA.fullmatch(word)]
        name = own[-1] if own else "camera"
        count = sum(re.fullmatch(rf"{re.escape(name)}(_\d+)?", each) is not None for each in found)
        found[f"{name}_{count + 1}" if count else name] = topic
    return found


# -- what is proposed -----------------------------------------------------------------------------
def proposal(
    domain: RosDomain,
    namespace: str,
    arm: DescribedArm,
    command: Topic,
    joints: Mapping[str, HeardJoints],
    images: Mapping[str, HeardImages],
) -> Proposal:
    """Parts of a profile for an arm that `command` moves.

    Args:
        joints: what was heard of joint states, by topic.
        images: what was heard of cameras, by topic.
    """
    guesses: list[tuple[str, str]] = []
    notes: list[str] = []
    section: dict[str, Any] = {"bridge": domain.bridge, "distribution": domain.distribution}
    section["domain"] = domain.number
    section |= _states(arm, joints, guesses, notes)
    kind = "joint" if command.type in (TRAJECTORY, NUMBERS) else "pose"
    section[f"{kind}_command"] = {"topic": command.name, "type": command.type}
    section |= _gripper(domain, namespace, arm, guesses, notes)
    cameras = camera_topics(domain, namespace)
    rows = {name: _camera(name, topic, images, guesses) for name, topic in cameras.items()}
    if cameras:
        section["cameras"] = {
            name: {"topic": topic.name, "type": topic.type} for name, topic in cameras.items()
        }
    else:
        notes.append("no topic of images was found: the profile has no camera")
    if namespace:
        section["prefix"] = f"{namespace}/vla"
    return Proposal(section, kind, rows, guesses, notes)


def _states(
    arm: DescribedArm,
    joints: Mapping[str, HeardJoints],
    guesses: list[tuple[str, str]],
    notes: list[str],
) -> dict[str, Any]:
    """Topics of the arm's and fingers' states, whose joints they have."""
    section: dict[str, Any] = {}
    topic = _that_has(arm.joints, joints) or "/joint_states"
    section["joint_states"] = topic
    heard = joints.get(topic, HeardJoints(0.0, {}, 0.0))
    if missing := [name for name in arm.joints if name not in heard.position]:
        why = f"{topic}; nothing was heard of {', '.join(missing)}"
        others = [name for name in heard.position if name not in arm.joints]
        why += f", but of {', '.join(others)}" if others else ""
        guesses.append(("ros2.joint_states", why))
    else:
        where = ", ".join(f"{name} {at:.3f}" for name, at in heard.position.items())
        notes.append(f"{topic}, {heard.rate_hz:.0f} Hz: {where}")
    if 0.0 < heard.rate_hz < SLOW_HZ:
        patience_s = LATE_STATES / heard.rate_hz
        notes.append(
            "joint states are slow: raise their rate, or timing.state_timeout_s to "
            f"{patience_s:.2f}"
        )
    if abs(heard.behind_s) > SIMULATED_S:
        section["use_sim_time"] = True
        guesses.append(("ros2.use_sim_time", "true; the stamps of joint states are not of today"))
    elsewhere = _that_has(arm.fingers, joints) if arm.fingers else None
    if elsewhere is not None and elsewhere != topic:
        section["finger_states"] = elsewhere
    elif arm.fingers and elsewhere is None:
        notes.append(f"nothing was heard of the finger joints {', '.join(arm.fingers)}")
    return section


def _that_has(names: Sequence[str], joints: Mapping[str, HeardJoints]) -> str | None:
    """The topic with most of these joints; the first of several, None if none has any."""
    counts = {topic: len({*names} & heard.position.keys()) for topic, heard in joints.items()}
    best = max(counts, key=lambda topic: counts[topic], default=None)
    return best if best is not None and counts[best] else None


def _gripper(
    domain: RosDomain,
    namespace: str,
    arm: DescribedArm,
    guesses: list[tuple[str, str]],
    notes: list[str],
) -> dict[str, Any]:
    found = gripper_commands(domain, namespace)
    deaf = [
        f"{name} ({domain.unreached[name]})"
        for name, kind in domain.actions.items()
        if kind in GRIPPER_ACTIONS and name in domain.unreached
    ]
    if deaf:
        notes.append(f"the bridge carries no goal to {', '.join(deaf)}: docs/how-to/ros2.md")
    if not arm.gripper or not found:
        if arm.gripper:
            notes.append("no action or topic of a gripper was found: it is not commanded")
        elif found:
            notes.append(f"the description has no gripper: {_named(found)} is not used")
        return {}
    first, *others = found
    section = {"topic": first.name, "type": first.type}
    grasps = [each for each in found if each.type == GRASP]
    if first.type == MOVE and grasps:
        section["grasp"] = grasps[0].name
        others = [each for each in others if each != grasps[0]]
    what = f"{first.name}, {first.type}"
    has_ends = any(key.startswith("joint_open") for key in arm.gripper)
    if not (first.type.startswith("franka_msgs/") or has_ends):
        meaning = "width" if "width" in first.name.rpartition("/")[2] else "finger"
        section["position"] = meaning
        what += f", whose number is taken for the {meaning} in m"
    what += f"; there is also: {_named(others)}" if others else ""
    guesses.append(("ros2.gripper", what))
    return {"gripper": section}


def _camera(
    name: str,
    topic: Topic,
    images: Mapping[str, HeardImages],
    guesses: list[tuple[str, str]],
) -> dict[str, Any]:
    row: dict[str, Any] = {"source": f"ros2:{topic.name}"}
    heard = images.get(topic.name)
    if heard is None:
        guesses.append((f"cameras.{name}", f"640x480; no image came on {topic.name}"))
        return row
    return row | {"width": heard.width, "height": heard.height}


def command_guess(
    command: Topic, others: Sequence[Topic], arm: DescribedArm, moved: Sequence[str] | None
) -> tuple[str, str]:
    """Place in the profile of the topic that moves the arm, and what is not known of it.

    That is nothing, an empty text, where its controller is active and has the joints of the arm.

    Args:
        moved: joints that its controller says it moves, see `arm_commands`.
    """
    kind = "joint" if command.type in (TRAJECTORY, NUMBERS) else "pose"
    if moved is not None and {*moved} == {*arm.joints}:
        return f"ros2.{kind}_command", ""
    what = f"{command.type}; whether its controller is active, and moves this arm, is not known"
    if moved is not None:
        said = f"moves {', '.join(moved)}" if moved else "is not active: it publishes no state"
        what = f"{command.type}; its controller {said}"
    if command.type == NUMBERS:
        what += f"; its numbers are taken for those of {', '.join(arm.joints)}, in this order"
    what += f"; there is also: {_named(others)}" if others else ""
    return f"ros2.{kind}_command", what


def _named(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{each.name} ({each.type})" for each in topics)
