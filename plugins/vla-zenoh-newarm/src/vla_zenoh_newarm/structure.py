"""Which joints of a description are the arm, which its gripper, and which link is the TCP."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from vla_zenoh.errors import ProfileError, nearest
from vla_zenoh.kinematics.description import MOVING, DescribedJoint, Description

MOST_JOINTS = 7
"""What lies before the last seven joints of a chain is a torso, rails or legs."""
FINGER_JOINTS = 4
"""A branch with at most this many joints in a row may be a finger."""
ARM_JOINTS, FINGERS = 5, 3
"""After this many joints in a row this many branches of one body are fingers, however long."""
FINGER = re.compile(r"finger|gripper|jaw|claw|knuckle|thumb|grip|pinch", re.IGNORECASE)
TCP = re.compile(r"tcp|tool0|tool_?center|grasp|end_?effector|(^|_)ee(_|$)|eef|gripper_frame", re.I)
FLANGE = re.compile(r"tool|flange|hand|palm|gripper", re.IGNORECASE)


class Structure(NamedTuple):
    """The arm in a description.

    Args:
        base: link of the poses.
        tcp: link that is controlled.
        arm: joints that are commanded, from the base outwards.
        fingers: joints of the hand that move by themselves.
        other_tcps: links that might be meant instead.
    """

    base: str
    tcp: str
    arm: tuple[str, ...]
    fingers: tuple[str, ...]
    other_tcps: tuple[str, ...]


def structure(described: Description, base: str | None, tcp: str | None) -> Structure:
    """The arm with the most joints, or that between two links.

    Raises:
        ProfileError: there is no such link, or nothing moves there.
    """
    for link in filter(None, (base, tcp)):
        if link not in described.links:
            raise ProfileError(
                f"{described.name} has no link {link!r}{nearest(link, described.links)} "
                f"It has: {', '.join(described.links)}"
            )
    tree = _Tree(described)
    ends = [tcp] if tcp else tree.tcps(base or described.root)
    if not ends:
        raise ProfileError(f"{described.name} has no joint that moves: it is no arm")
    last = ends[0]
    arm = tree.moving(base or described.root, last)
    if not arm:
        raise ProfileError(
            f"no joint of {described.name} moves {last!r} against {base or described.root!r}: "
            "give --tcp a link further out"
        )
    if base is None:
        arm = arm[-MOST_JOINTS:]
        before = tree.all_moving(described.root, arm[0].parent)
        base = arm[0].parent if before else described.root
    hand = [joint for joint in tree.below(arm[-1].child) if tree.is_own(joint)]
    fingers = tuple(joint.name for joint in hand if joint not in arm)
    return Structure(base, last, tuple(joint.name for joint in arm), fingers, tuple(ends[1:]))


class _Tree:
    """The joints below each link."""

    def __init__(self, described: Description) -> None:
        self._described = described
        self._children: dict[str, list[DescribedJoint]] = {link: [] for link in described.links}
        for joint in described.joints.values():
            self._children[joint.parent].append(joint)

    def is_own(self, joint: DescribedJoint) -> bool:
        """Whether it moves by itself, in one way."""
        mimics = joint.mimic is not None and joint.mimic.joint in self._described.joints
        return joint.kind in MOVING and not mimics

    def all_moving(self, first: str, last: str) -> list[DescribedJoint]:
        return [joint for joint in self._described.chain(first, last) if joint.moves]

    def moving(self, first: str, last: str) -> list[DescribedJoint]:
        """Joints on the way that move by themselves."""
        return [joint for joint in self._described.chain(first, last) if self.is_own(joint)]

    def below(self, link: str) -> Iterator[DescribedJoint]:
        for joint in self._children[link]:
            yield joint
            yield from self.below(joint.child)

    def depth(self, joint: DescribedJoint) -> int:
        """Most moving joints in a row from this one outwards."""
        below = max((self.depth(each) for each in self._children[joint.child]), default=0)
        return below + joint.moves

    def tcps(self, base: str) -> list[str]:
        """A link for the TCP of each arm, that with the most joints first."""
        leaves = [link for link in self._described.links if not self._children[link]]
        ways = [self._way_of_arm(base, leaf) for leaf in leaves]
        longest = max((self._own(way) for way in ways), default=0)
        if not longest:
            return []
        # Of two arms of one kind each; of legs or a head beside an arm only the arm.
        tips = [way for way in ways if self._own(way) == longest]
        return list(dict.fromkeys(self._tcp(way[-1].child) for way in tips if way))

    def _own(self, way: Sequence[DescribedJoint]) -> int:
        return sum(self.is_own(joint) for joint in way)

    def _way_of_arm(self, base: str, leaf: str) -> list[DescribedJoint]:
        """Joints from the base to the last that is no finger's."""
        way = list(self._described.chain(base, leaf))
        moving = [index for index, joint in enumerate(way) if joint.moves]
        for index in moving:
            joint = way[index]
            if self._is_finger(joint) and self._own(way[:index]):
                return way[: max(i for i in moving if i < index) + 1]
        return way[: moving[-1] + 1] if moving else []

    def _is_finger(self, joint: DescribedJoint) -> bool:
        if self.depth(joint) > FINGER_JOINTS:
            return self._in_a_hand(joint)
        is_last = not any(self.is_own(each) for each in self.below(joint.child))
        if not self.is_own(joint):
            return is_last
        if FINGER.search(joint.name):
            return True
        mimicked = [each.mimic.joint for each in self._described.joints.values() if each.mimic]
        # What others follow and more joints come after is a linkage of the arm.
        return (joint.name in mimicked and is_last) or self._in_a_hand(joint)

    def _in_a_hand(self, joint: DescribedJoint) -> bool:
        """Whether it begins one of several branches of one body, after a real arm."""
        body = joint.parent
        way = list(self._described.chain(self._described.root, body))
        while way and not way[-1].moves:
            body = way.pop().parent
        siblings = [each for each in self._first_moving(body) if each.moves]
        short = all(self.depth(each) <= FINGER_JOINTS for each in siblings)
        if len(siblings) >= FINGERS and self._own(way) >= ARM_JOINTS:
            return True
        return len(siblings) > 1 and short and self._own(way) > 2

    def _first_moving(self, link: str) -> Iterator[DescribedJoint]:
        for joint in self._children[link]:
            if joint.moves:
                yield joint
            else:
                yield from self._first_moving(joint.child)

    def _tcp(self, link: str) -> str:
        """Of the links that are fixed to `link`, that which is named as a TCP, or the outermost."""
        fixed = [link, *self._fixed_to(link)]
        for wanted in (TCP, FLANGE):
            named = [each for each in fixed if wanted.search(each)]
            if named:
                return named[-1]
        return fixed[-1] if len(fixed) == 2 else link

    def _fixed_to(self, link: str) -> Iterator[str]:
        for joint in self._children[link]:
            if not joint.moves:
                yield joint.child
                yield from self._fixed_to(joint.child)
