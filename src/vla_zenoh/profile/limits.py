"""Section ``limits`` of a profile: bounds of every motion. The defaults are conservative."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from vla_zenoh.profile.section import (
    REACH_M,
    Angle,
    Fault,
    Name,
    Point,
    Range,
    Section,
    Vector3,
)


def _one_for_all(value: Any) -> Any:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (value,)
    return value


def _not_empty(values: tuple[float, ...]) -> tuple[float, ...]:
    if not values:
        raise ValueError("is empty: give one number for all joints, or one each")
    return values


_PerJoint = (
    Field(strict=False, max_length=64),
    BeforeValidator(_one_for_all),
    AfterValidator(_not_empty),
)
Velocity = Annotated[float, Field(ge=1e-3, le=2.61)]
Acceleration = Annotated[float, Field(ge=1e-2, le=20)]
Jerk = Annotated[float, Field(ge=0.1, le=10_000)]


class JointLimits(Section):
    """One number for all joints, or one per joint in the order of ``robot.arm_joints``.

    Franka publishes for the Panda, joint 1 to 7 ("Robot and interface specifications" of the Franka
    Control Interface documentation):

        velocity      2.175  2.175  2.175  2.175  2.61   2.61   2.61   rad/s
        acceleration  15     7.5    10     12.5   15     20     20     rad/s^2
        jerk          7500   3750   5000   6250   7500   10000  10000  rad/s^3

    The largest of each row is the upper bound. The defaults are half the velocity, 30 % of the
    acceleration and 5 % of the jerk of the row's smallest, for every joint; the Panda's own profile
    has the same shares joint by joint.

    A joint that slides has m/s, m/s^2 and m/s^3.

    Args:
        velocity_rad_s: of the commanded motion; less where the description allows less.
        acceleration_rad_s2: of the commanded motion.
        jerk_rad_s3: of the commanded motion, and of the robot's own stop.
    """

    velocity_rad_s: Annotated[tuple[Velocity, ...], *_PerJoint] = (1.0875,)
    acceleration_rad_s2: Annotated[tuple[Acceleration, ...], *_PerJoint] = (2.25,)
    jerk_rad_s3: Annotated[tuple[Jerk, ...], *_PerJoint] = (187.5,)

    def of(self, name: str, joints: int) -> tuple[float, ...]:
        """The limit `name` as one number per joint."""
        values: tuple[float, ...] = getattr(self, name)
        return values * joints if len(values) == 1 else values


REJECT_FACTOR = 4.0
"""A step this many times over its limit has the wrong unit, and is rejected."""


def _within_reach(pair: tuple[float, float]) -> tuple[float, float]:
    if max(map(abs, pair)) > REACH_M:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is beyond {REACH_M:g} m; give metres")
    return pair


Reach = Annotated[Range, AfterValidator(_within_reach)]


class Workspace(Section):
    """Workspace box of the TCP in the base frame, m."""

    x_m: Reach = (0.2, 0.75)
    y_m: Reach = (-0.45, 0.45)
    z_m: Reach = (0.012, 0.9)

    @property
    def corners_m(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner."""
        (x, to_x), (y, to_y), (z, to_z) = self.x_m, self.y_m, self.z_m
        return (x, y, z), (to_x, to_y, to_z)

    def __str__(self) -> str:
        return f"x {self.x_m} y {self.y_m} z {self.z_m}"


class TranslationLimits(Section):
    """Limits per axis of the base frame."""

    velocity_m_s: float = Field(default=0.5, ge=1e-3, le=1.7)
    acceleration_m_s2: float = Field(default=2.0, ge=1e-2, le=13)
    jerk_m_s3: float = Field(default=20.0, ge=0.1, le=6500)


class RotationLimits(Section):
    """Limits of the TCP's rotation, by its norm: about any axis. To keep them the arm
    turns at up to 0.55 of them about each axis of the base, and 0.95 about all three at once.
    """

    velocity_rad_s: float = Field(default=1.5, ge=1e-3, le=2.5)
    acceleration_rad_s2: float = Field(default=6.0, ge=1e-2, le=25)
    jerk_rad_s3: float = Field(default=60.0, ge=0.1, le=12500)


Edge = Annotated[float, Field(gt=0, le=2 * REACH_M)]
LinkPair = Annotated[tuple[str, str], Field(strict=False)]
LinkPairs = Annotated[tuple[LinkPair, ...], Field(strict=False, max_length=64)]
Edges = Annotated[tuple[Edge, Edge, Edge], Field(strict=False)]


class KeepOut(Section):
    """A box, sphere or half-space in the base frame that no link may enter: one of the three.

    The arm and its hand slow down at ``collision_slow_m`` from it and stop at ``collision_stop_m``.

    Args:
        centre_m: of the box or sphere; of a half-space, a point of its plane.
        box_m: edges of a box along x, y and z, before it is turned.
        yaw_rad: of the box, about z.
        radius_m: of a sphere.
        normal: of a plane, pointing to the side where the arm may be; of any length.
    """

    centre_m: Point
    box_m: Edges | None = None
    yaw_rad: Angle = 0.0
    radius_m: float | None = Field(default=None, gt=0, le=REACH_M)
    normal: Vector3 | None = None

    def contradictions(self) -> Iterator[Fault]:
        shapes = {"box_m": self.box_m, "radius_m": self.radius_m, "normal": self.normal}
        given = [name for name, value in shapes.items() if value is not None]
        if len(given) != 1:
            had = f"has {' and '.join(given)}" if given else "has no shape"
            yield (), f"{had}; give one of {', '.join(shapes)}"
        if self.normal is not None and not any(self.normal):
            yield ("normal",), "is zero; give a direction, as [0, 1, 0]"
        if self.yaw_rad and self.box_m is None:
            yield ("yaw_rad",), "rotates a box; this is not one"


class ReachLimits(Section):
    """Limits of goals by the arm's kinematics; see `vla_zenoh.control.reachability`.

    Args:
        joint_margin_rad: kept from both ends of the range of every joint that turns.
        joint_margin_m: of every joint that slides.
        singularity_slow: smallest singular value of the Jacobian below which the arm slows down and
            shortens steps.
        singularity_stop: lower bound of that singular value.
        collision_slow_m: distance of the arm to itself below which the arm slows down.
        collision_stop_m: lower bound of that distance, and of the arm without its hand to the
            table.
        table_z_m: height of the table in the base frame; null: no table.
        table_slow_m: distance of hand and fingers to the table below which the arm slows down; they
            work close to it.
        table_stop_m: lower bound of that distance.
        keep_out: name -> shape that the arm keeps out of: a camera's post, a wall, a person's side.
        may_touch: pairs of links, or of a link and ``table``, whose distance is not checked: their
            shapes, which are convex hulls, touch where the links do not.
        part_slow_m: distance of two parts of a robot below which both slow down.
        part_stop_m: lower bound of that distance.
    """

    joint_margin_rad: float = Field(default=0.05, ge=0, le=0.5)
    joint_margin_m: float = Field(default=0.01, ge=0, le=0.1)
    singularity_slow: float = Field(default=0.05, ge=0, le=0.5)
    singularity_stop: float = Field(default=0.015, ge=0, le=0.5)
    collision_slow_m: float = Field(default=0.05, ge=0, le=0.3)
    collision_stop_m: float = Field(default=0.02, ge=0, le=0.3)
    table_z_m: float | None = Field(default=0.0, ge=-2, le=2)
    table_slow_m: float = Field(default=0.002, ge=0, le=0.3)
    table_stop_m: float = Field(default=0.001, ge=0, le=0.3)
    keep_out: dict[Name, KeepOut] = Field(default_factory=dict, max_length=32)
    may_touch: LinkPairs = ()
    part_slow_m: float = Field(default=0.12, ge=0, le=1)
    part_stop_m: float = Field(default=0.03, ge=0.005, le=1)

    def contradictions(self) -> Iterator[Fault]:
        for name in ("singularity{}", "collision{}_m", "table{}_m", "part{}_m"):
            slow, stop = name.format("_slow"), name.format("_stop")
            before, at = getattr(self, slow), getattr(self, stop)
            if at > before:
                yield (stop,), f"is {at:g}, which must not be above {slow} ({before:g})"


class ContactLimits(Section):
    """Contact forces at which the arm slows down and gives up; see `vla_zenoh.control.contact`.

    The arm slows down by forces relative to those at activation. It stops by the greater of the
    force that the robot reports and its change since the activation.

    Args:
        force_slow_n: external force at the TCP above which the arm slows down.
        force_stop_n: force above which the activation ends, and the arm retreats a little.
        torque_slow_nm: external torque about the TCP above which the arm slows down.
        torque_stop_nm: torque above which the activation ends.
        effort_slow_nm: largest external torque of a joint above which the arm slows down, for a
            robot whose `JointState.effort_nm` is external. That of ROS 2 and of the simulator
            includes the arm's own weight. null: not checked.
        effort_stop_nm: joint torque above which the activation ends.
        retreat_m_s: largest speed at which a blocked arm's goal returns to its measured pose.
    """

    force_slow_n: float = Field(default=15.0, gt=0, le=200)
    force_stop_n: float = Field(default=40.0, gt=0, le=200)
    torque_slow_nm: float = Field(default=6.0, gt=0, le=80)
    torque_stop_nm: float = Field(default=15.0, gt=0, le=80)
    effort_slow_nm: float | None = Field(default=None, gt=0, le=200)
    effort_stop_nm: float | None = Field(default=None, gt=0, le=200)
    retreat_m_s: float = Field(default=0.15, gt=0, le=0.5)

    def contradictions(self) -> Iterator[Fault]:
        for name in ("force{}_n", "torque{}_nm", "effort{}_nm"):
            slow, stop = name.format("_slow"), name.format("_stop")
            before, at = getattr(self, slow), getattr(self, stop)
            if before is not None and (at is None or before >= at):
                yield (slow,), f"is {before}, which must be below {stop} ({at})"


class Limits(Section):
    """Limits of every motion; the upper bounds are Franka's published ones for the Panda.

    Args:
        workspace: box of the TCP.
        translation: of the smoothed motion.
        rotation: of the smoothed motion.
        joint: of a motion commanded by joint positions.
        reach: by joint ranges, singularities, the arm itself and the table.
        contact: of forces and torques.
        step_m: largest translation of one action step.
        step_rad: largest rotation of one action step.
        approach_m_s: speed towards an absolute target while it is further away than a step; the
            last step is as fast as any other.
        approach_rad_s: angular speed towards it.
        out_of_bounds: ``clamp`` shortens to the limit and emits an event, ``refuse`` rejects the
            whole chunk.
        lead_m: leash: largest distance of the goal from the commanded pose.
        lead_rad: leash: largest angle between the two.
        tracking_m: leash: largest distance of commanded and measured pose; beyond it the arm is
            blocked: it brakes, and the goal returns to the measured pose.
        tracking_rad: leash: largest angle between the two.
        elbow_rad: largest deviation of a measured joint from where it is expected at the same TCP
            pose; beyond it the arm slows down, at twice that it brakes. Of a joint that slides,
            tracking_m.
    """

    workspace: Workspace = Workspace()
    translation: TranslationLimits = TranslationLimits()
    rotation: RotationLimits = RotationLimits()
    joint: JointLimits = JointLimits()
    reach: ReachLimits = ReachLimits()
    contact: ContactLimits = ContactLimits()
    step_m: float = Field(default=0.05, gt=0, le=0.2)
    step_rad: float = Field(default=0.2, gt=0, le=0.8)
    approach_m_s: float = Field(default=0.1, gt=0, le=0.5)
    approach_rad_s: float = Field(default=0.5, gt=0, le=1.5)
    out_of_bounds: Literal["clamp", "refuse"] = "clamp"
    lead_m: float = Field(default=0.15, gt=0, le=0.5)
    lead_rad: float = Field(default=0.6, gt=0, le=1.5)
    tracking_m: float = Field(default=0.05, gt=0, le=0.2)
    tracking_rad: float = Field(default=0.3, gt=0, le=1.0)
    elbow_rad: float = Field(default=0.35, gt=0, le=1.5)

    @property
    def tcp_box(self) -> Workspace:
        """Where the TCP may be, by all limits on its place.

        What makes goals, bounds, judges or shows them reads this and not `workspace`, so a further
        limit has one place: here it narrows the box.
        """
        return self.workspace

    def contradictions(self) -> Iterator[Fault]:
        for step, lead in (("step_m", "lead_m"), ("step_rad", "lead_rad")):
            value, limit = getattr(self, step), getattr(self, lead)
            if value > limit:
                yield (step,), f"is {value:g}, longer than the leash {lead} ({limit:g})"
