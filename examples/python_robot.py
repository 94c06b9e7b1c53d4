"""A robot driver: an arm without hardware that is always where it was commanded to be.

    vla-zenoh up examples/python_robot.yaml
    vla-zenoh --help                                 # drive it as any other

Replace the three comments by calls of your robot's library.
"""

import numpy as np

from vla_zenoh.robot import Command, Reading


class PerfectArm:
    """Seven joints, no gripper. Options of the profile arrive as keyword arguments, as text."""

    def __init__(self, address: str) -> None:
        print("connecting to", address)  # connect here
        self.position_rad = np.array([0.0, -0.044, 0.0, -2.627, 0.0, 2.583, 0.785])

    def read(self) -> Reading:
        """Return the newest state at once."""
        return Reading(position_rad=self.position_rad)  # measured joints here

    def move(self, command: Command) -> None:
        """Be there now; called 250 times a second with a jerk-limited stream."""
        self.position_rad = np.array(command.position_rad)  # send the set-point here
