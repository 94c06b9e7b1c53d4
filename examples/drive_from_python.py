"""Drives a robot: sets the prompt, activates, waits until the arm has moved, deactivates.

    vla-zenoh up panda_sim                           # in another terminal
    python examples/drive_from_python.py [PROFILE]

The arm stays active only while this program runs: if it crashes, the arm brakes.
"""

import sys
import time

import vla_zenoh

MOVE_M, PATIENCE_S = 0.05, 10.0


def main(profile: str = "panda_sim") -> None:
    """Move the arm up by `MOVE_M` and print where it is."""
    with vla_zenoh.connect(profile) as robot:
        start_m = robot.pose_state().record.position_m
        robot.set_prompt("HARD: go up x10")
        robot.activate_with_deadman("example")
        give_up_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up_s:
            position_m = robot.pose_state().record.position_m
            print(f"z = {position_m[2]:.3f} m")
            if position_m[2] - start_m[2] > MOVE_M:
                break
            time.sleep(0.2)
        stands = robot.deactivate()
        print("the arm stands" if stands else "the arm still moves")


if __name__ == "__main__":
    main(*sys.argv[1:])
