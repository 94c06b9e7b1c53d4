"""How long the robot's own stop takes at most, when the stream of commands has ended."""

from __future__ import annotations

from vla_zenoh.control.smoothing import ROTATION_BOX
from vla_zenoh.guard.command_stream import ACCELERATE_S, BRAKE_MARGIN
from vla_zenoh.guard.joint_guard import joint_motion_limits
from vla_zenoh.guard.pose_guard import guard_limits
from vla_zenoh.profile import Profile


def max_braking_time_s(profile: Profile) -> float:
    """From the last command until the arm stands, whatever motion the robot's side followed.

    That may be faster than the profile's limits, by `BRAKE_MARGIN`, and still be gaining speed.
    """
    if profile.robot.command == "joint":
        limits = joint_motion_limits(profile, BRAKE_MARGIN)
        stops_s = [_stop_s(*map(float, axis), share=1.0) for axis in zip(*limits, strict=True)]
    else:
        brake = guard_limits(profile).brake
        stops_s = [
            _stop_s(*brake.translation, share=1.0),
            _stop_s(*brake.rotation, share=ROTATION_BOX),
        ]
    return profile.timing.command_timeout_s + max(stops_s)


def _stop_s(velocity: float, acceleration: float, jerk: float, share: float) -> float:
    """Of one axis that moves at both limits, by this share of acceleration and jerk.

    The acceleration fades first, and is believed for a while before; then the axis slows down: by a
    trapezoid of acceleration, than which the triangle of a short stop is shorter.
    """
    most, change = share * acceleration, share * jerk
    fades_s = acceleration / change
    reached = velocity + acceleration * (ACCELERATE_S + 0.5 * fades_s)
    return fades_s + reached / most + most / change
