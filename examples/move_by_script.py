"""Moves the arm by a script: home, two poses, the gripper, then a model until it is high.

    vla-zenoh up panda_sim                           # in another terminal
    vla-zenoh node primitives --profile panda_sim    # in a third one
    python examples/move_by_script.py [PROFILE]

Each motion is checked before it begins and kept within the bounds of the profile. The arm moves
only while this program waits: if it crashes, the arm brakes.
"""

import sys

import vla_zenoh

FRONT_M, LEFT_M = (0.50, 0.0, 0.30), (0.45, 0.15, 0.25)
TOO_LOW_M = (0.50, 0.0, -0.20)
HIGH = {"low_m": (0.2, -0.4, 0.33), "high_m": (0.7, 0.4, 0.9)}


def main(profile: str = "panda_sim") -> None:
    """Print where the arm stands after each motion."""
    with vla_zenoh.connect(profile) as robot:
        robot.home()
        robot.grip("open")
        for position_m in (FRONT_M, LEFT_M):
            found = robot.move_to(position_m)
            print(f"{found.reason} in {found.took_s:.1f} s, {1e3 * (found.off_m or 0):.2f} mm off")
        try:
            robot.move_to(TOO_LOW_M)
        except vla_zenoh.PrimitiveError as error:
            print(f"nothing moved: {error}")
        found = robot.run("scripted", {"inside": HIGH}, prompt="HARD: go up", timeout_s=20)
        print(f"the model was stopped: {found.reason}, at z = {found.position_m[2]:.3f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
