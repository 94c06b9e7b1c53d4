"""The part of a profile that bounds every motion. The defaults are the safe choice."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from vla_zenoh.profile.section import Range, Section, reject


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
Velocity = Annotated[float, Field(gt=0, le=2.61)]
Acceleration = Annotated[float, Field(gt=0, le=20)]
Jerk = Annotated[float, Field(gt=0, le=10_000)]


class JointLimits(Section):
    """One number for all joints, or one for each in the order of ``robot.arm_joints``.

    Args:
        velocity_rad_s: of the commanded motion.
        acceleration_rad_s2: likewise.
        jerk_rad_s3: likewise, and of the robot's own stop.
    """

    velocity_rad_s: Annotated[tuple[Velocity, ...], *_PerJoint] = (1.0875,)
    acceleration_rad_s2: Annotated[tuple[Acceleration, ...], *_PerJoint] = (2.25,)
    jerk_rad_s3: Annotated[tuple[Jerk, ...], *_PerJoint] = (187.5,)

    def of(self, name: str, joints: int) -> tuple[float, ...]:
        """The limit called `name`, one number for each of so many joints."""
        values: tuple[float, ...] = getattr(self, name)
        return values * joints if len(values) == 1 else values


REACH_M = 3.0
"""No arm that fits a table reaches further: a workspace beyond it is in other units."""
REJECT_FACTOR = 4.0
"""A step this many times over its limit is a mistake (a wrong unit), not a motion: refused."""


def _within_reach(pair: tuple[float, float]) -> tuple[float, float]:
    if max(map(abs, pair)) > REACH_M:
        raise ValueError(f"[{pair[0]:g}, {pair[1]:g}] is further than {REACH_M:g} m; give metres")
    return pair


Reach = Annotated[Range, AfterValidator(_within_reach)]


class Workspace(Section):
    """Box in the base frame that the TCP must not leave, in m."""

    x_m: Reach = (0.2, 0.75)
    y_m: Reach = (-0.45, 0.45)
    z_m: Reach = (0.012, 0.9)


class TranslationLimits(Section):
    """Per axis of the base frame."""

    velocity_m_s: float = Field(default=0.5, gt=0, le=1.7)
    acceleration_m_s2: float = Field(default=2.0, gt=0, le=13)
    jerk_m_s3: float = Field(default=20.0, gt=0, le=6500)


class RotationLimits(Section):
    """Per axis of the rotation vector."""

    velocity_rad_s: float = Field(default=1.5, gt=0, le=2.5)
    acceleration_rad_s2: float = Field(default=6.0, gt=0, le=25)
    jerk_rad_s3: float = Field(default=60.0, gt=0, le=12500)


class ReachLimits(Section):
    """What the arm's kinematics allow a goal to be; see `vla_zenoh.control.reachability`.

    Args:
        joint_margin_rad: kept from both ends of every joint's range.
        singularity_slow: smallest singular value of the Jacobian below which the arm gets slower
            and steps shorter.
        singularity_stop: it gets no smaller than this.
        collision_slow_m: distance of the arm to itself below which likewise.
        collision_stop_m: it comes no nearer; also the arm, without its hand, to the table.
        table_z_m: height of the table in the base frame; null: there is none.
        table_slow_m: likewise for hand and fingers, which have work to do there.
        table_stop_m: they come no nearer.
    """

    joint_margin_rad: float = Field(default=0.05, ge=0, le=0.5)
    singularity_slow: float = Field(default=0.05, ge=0, le=0.5)
    singularity_stop: float = Field(default=0.015, ge=0, le=0.5)
    collision_slow_m: float = Field(default=0.05, ge=0, le=0.3)
    collision_stop_m: float = Field(default=0.02, ge=0, le=0.3)
    table_z_m: float | None = Field(default=0.0, ge=-2, le=2)
    table_slow_m: float = Field(default=0.002, ge=0, le=0.3)
    table_stop_m: float = Field(default=0.001, ge=0, le=0.3)

    @model_validator(mode="after")
    def _a_stop_lies_behind_its_slow(self) -> ReachLimits:
        reject(
            [
                ((stop,), f"is {at:g}, which must not be above {slow} ({before:g})")
                for slow, before, stop, at in (
                    (
                        "singularity_slow",
                        self.singularity_slow,
                        "singularity_stop",
                        self.singularity_stop,
                    ),
                    (
                        "collision_slow_m",
                        self.collision_slow_m,
                        "collision_stop_m",
                        self.collision_stop_m,
                    ),
                    ("table_slow_m", self.table_slow_m, "table_stop_m", self.table_stop_m),
                )
                if at > before
            ]
        )
        return self


class ContactLimits(Section):
    """What the arm may press with before it gives up; see `vla_zenoh.control.contact`.

    What the robot says of forces is looked at without what was there when it was activated.

    Args:
        force_slow_n: external force at the TCP above which the arm gets slower.
        force_stop_n: above it the activation ends, and the arm goes back a little.
        torque_slow_nm: likewise the external torque about the TCP.
        torque_stop_nm: likewise.
        effort_slow_nm: likewise the greatest external torque of a joint. For a robot whose
            `JointState.effort_nm` tells that; ROS 2's and the simulator's is all that the motors
            apply, the arm's own weight included. null: not looked at.
        effort_stop_nm: likewise.
        retreat_m_s: how fast an arm that was blocked is led back to where it is, at most.
    """

    force_slow_n: float = Field(default=15.0, gt=0, le=200)
    force_stop_n: float = Field(default=40.0, gt=0, le=200)
    torque_slow_nm: float = Field(default=6.0, gt=0, le=80)
    torque_stop_nm: float = Field(default=15.0, gt=0, le=80)
    effort_slow_nm: float | None = Field(default=None, gt=0, le=200)
    effort_stop_nm: float | None = Field(default=None, gt=0, le=200)
    retreat_m_s: float = Field(default=0.15, gt=0, le=0.5)

    @model_validator(mode="after")
    def _a_stop_lies_above_its_slow(self) -> ContactLimits:
        reject(
            [
                ((slow,), f"is {before}, which must be below {stop} ({at})")
                for slow, before, stop, at in (
                    ("force_slow_n", self.force_slow_n, "force_stop_n", self.force_stop_n),
                    ("torque_slow_nm", self.torque_slow_nm, "torque_stop_nm", self.torque_stop_nm),
                    ("effort_slow_nm", self.effort_slow_nm, "effort_stop_nm", self.effort_stop_nm),
                )
                if before is not None and (at is None or before >= at)
            ]
        )
        return self


class Limits(Section):
    """Bounds of every motion; upper bounds are Franka's published ones for the Panda.

    Args:
        workspace: box of the TCP.
        translation: of the smoothed motion.
        rotation: likewise.
        joint: of a motion commanded by joint positions.
        reach: what joints, singularities, the arm itself and the table allow.
        contact: what may press against the arm.
        step_m: largest translation of one model step.
        step_rad: largest rotation of one model step.
        approach_m_s: an absolute target further away than a step is gone to at this speed.
        approach_rad_s: likewise.
        out_of_bounds: ``clamp`` shortens to the bound and tells, ``reject`` drops the whole chunk.
        lead_m: leash: the goal may run ahead of the commanded pose by this much.
        lead_rad: likewise.
        tracking_m: leash: commanded minus measured pose; more brakes the arm (it is blocked), and
            leads it back to where it is.
        tracking_rad: likewise.
        elbow_rad: a measured joint may be so far from where the arm is believed to have it at the
            same TCP pose; beyond it gets slower, at twice that it brakes.
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

    @model_validator(mode="after")
    def _a_step_fits_the_leash(self) -> Limits:
        reject(
            [
                ((step,), f"is {value:g}, longer than the leash {lead} ({limit:g})")
                for step, value, lead, limit in (
                    ("step_m", self.step_m, "lead_m", self.lead_m),
                    ("step_rad", self.step_rad, "lead_rad", self.lead_rad),
                )
                if value > limit
            ]
        )
        return self
