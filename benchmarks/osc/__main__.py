"""How far a policy of LIBERO or robosuite moves our arm, and robosuite's with its own controller.

    python -m benchmarks.osc [-n 200] [--seed 1] [-o FILE.json]

Random action sequences of two seconds at 20 Hz are played through robosuite's own OSC_POSE on its
Panda (`robosuite_paths.py`, in an environment of its own that uv makes), and through our command
node, guard and simulated Panda in lockstep, from the same joints: once with the controller declared
(``controller: 150:1``), once with deltas added to the goal, as they are without it.

Compared is the displacement of the TCP since the start, after every step, at the same time; ours is
shifted by one constant time for all sequences, which is reported: the delay of smoothing and
control. A sequence is a sine of its own on every axis with noise on it; ``--turns`` has rotations
as well.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from uv import find_uv_bin
from vla_zenoh_benchmarks.lockstep.worker import Delays

from benchmarks.lockstep_arm import activated, in_processes
from vla_zenoh.kinematics.so3 import log3
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ControllerSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import FloatArray

STEPS, DT_S = 40, 0.05
SCALE = np.repeat([0.05, 0.5], 3)
CONTROLLER = ControllerSpec(kp=150.0, damping_ratio=1.0)
SINE_HZ, SINE, NOISE = (0.5, 1.5), 0.5, 0.3
HEIGHT = 0.3
"""Factor on vertical motion: the arm would meet the table if each step were covered whole."""
TURN = 0.3
"""Share of a full turn: faster ones are above the profile's limit."""
SHIFTS_S = np.arange(0.0, 0.3, 0.004)
RATE_HZ, HORIZON = 2.5, 16
MODES = {"controller": CONTROLLER, "goal": None}


def sequences(count: int, seed: int, *, turns: bool) -> FloatArray:
    """(count, STEPS, 6) actions in [-1, 1]."""
    rng = np.random.default_rng(seed)
    shape = (count, 1, 6)
    time_s = DT_S * np.arange(STEPS)[None, :, None]
    angle = 2 * np.pi * (rng.uniform(*SINE_HZ, shape) * time_s + rng.uniform(0, 1, shape))
    noise = rng.uniform(-NOISE, NOISE, (count, STEPS, 6))
    actions = rng.uniform(0, SINE, shape) * np.sin(angle) + noise
    actions[..., 2] *= HEIGHT
    actions[..., 3:] *= TURN if turns else 0.0
    return actions.clip(-1, 1)


class Played:
    """A policy that plays one sequence when it is prompted to, 16 steps in a chunk."""

    def __init__(self, actions: FloatArray, controller: ControllerSpec | None) -> None:
        still = np.zeros((HORIZON, 6))
        self._steps = np.concatenate([actions * SCALE, still])
        self.begins, self._begun_ns = False, 0
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(cameras=(CameraSpec(camera="front"),), prompt=False),
            action=ActionSpec(
                horizon=HORIZON, dt_s=DT_S, rotation="rotvec", gripper="none", controller=controller
            ),
        )

    def infer(self, observation: Observation) -> ActionSteps:
        """The steps from the time of the observation on; images come as often as steps."""
        stamp_ns = observation.stamp_wall_ns
        if not self.begins:
            return ActionSteps(self._steps[-HORIZON:])
        self._begun_ns = self._begun_ns or stamp_ns
        first = min(round((stamp_ns - self._begun_ns) / 1e9 / DT_S), STEPS)
        return ActionSteps(self._steps[first : first + HORIZON])


def profile_at(joints_rad: FloatArray) -> Profile:
    """The simulated Panda, beginning there, with limits that do not act on these sequences."""
    return override(
        load_profile("panda_sim"),
        {
            "robot": {"home_rad": joints_rad.tolist()},
            "limits": {
                "workspace": {"x_m": [0.1, 0.85], "y_m": [-0.6, 0.6], "z_m": [-0.3, 1.0]},
                "translation": {"velocity_m_s": 1.0, "acceleration_m_s2": 10.0, "jerk_m_s3": 1000},
                "rotation": {
                    "velocity_rad_s": 2.5,
                    "acceleration_rad_s2": 25.0,
                    "jerk_rad_s3": 3000.0,
                },
                "reach": {"table_z_m": None},
            },
        },
    )


def play(mode: str, index: int, actions: FloatArray, joints_rad: FloatArray) -> dict[str, Any]:
    """One sequence through our chain: measured displacements at every shift."""
    policy = Played(actions, MODES[mode])
    delays = Delays(0.0, camera_hz=1 / DT_S, camera_s=0.0, wire_s=0.0)
    loop = activated(profile_at(joints_rad), policy, delays, RATE_HZ, 1, perfect=False)
    policy.begins = True
    chunks = loop.commander.progress.chunks
    loop.run_until(lambda: loop.commander.progress.chunks > chunks, 2 / RATE_HZ)
    start_m, start = loop.world.tcp()
    since = len(loop.trace.time_ns)
    began_ns = loop.now_ns
    loop.run(STEPS * DT_S + SHIFTS_S[-1])
    time_s = (np.array(loop.trace.time_ns[since:]) - began_ns) / 1e9
    moved_m = np.array(loop.trace.position_m[since:]) - start_m
    turned = np.array([log3(rotation @ start.T) for rotation in loop.trace.rotation[since:]])
    at_s = SHIFTS_S[:, None] + DT_S * np.arange(1, STEPS + 1)
    return {
        "mode": mode,
        "index": index,
        "moved_m": np.stack([np.interp(at_s, time_s, axis) for axis in moved_m.T], axis=-1),
        "turned_rad": np.stack([np.interp(at_s, time_s, axis) for axis in turned.T], axis=-1),
        "limits": sorted({event.what for event in loop.events if event.kind == "limit"}),
        "ended": loop.commander.why if not loop.commander.task.active else "",
    }


def robosuite_paths(actions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacements (n, STEPS, 3) m and rad of robosuite's arm, and its joints at the start."""
    with tempfile.TemporaryDirectory() as folder:
        given, written = Path(folder, "actions.npy"), Path(folder, "paths.npz")
        np.save(given, actions)
        script = Path(__file__).with_name("robosuite_paths.py")
        command = [find_uv_bin(), "run", "--no-project", "--script", script, given, written]
        subprocess.run([str(part) for part in command], check=True)
        with np.load(written) as data:
            position_m, rotation = data["position_m"], data["rotation"]
            joints_rad = data["joints_rad"]
    turned = [[log3(each @ path[0].T) for each in path[1:]] for path in rotation]
    return position_m[:, 1:] - position_m[:, :1], np.array(turned), joints_rad


def compare(ours: list[dict[str, Any]], moved_m: FloatArray, turned: FloatArray) -> dict[str, Any]:
    """Differences of one mode, at the shift at which their median is least."""
    order = [each["index"] for each in ours]
    off_m = np.array([each["moved_m"] for each in ours]) - moved_m[order][:, None]
    far_m = np.linalg.norm(off_m, axis=-1)
    best = int(np.median(far_m, axis=(0, 2)).argmin())
    off = np.array([each["turned_rad"][best] for each in ours]) - turned[order]
    return {
        "shift_ms": round(float(SHIFTS_S[best]) * 1e3),
        "off_mm": _spread(far_m[:, best] * 1e3),
        "end_off_mm": _spread(far_m[:, best, -1] * 1e3),
        "off_mrad": _spread(np.linalg.norm(off, axis=-1) * 1e3),
        "limits": sorted({what for each in ours for what in each["limits"]}),
        "ended": [each["ended"] for each in ours if each["ended"]],
    }


def _spread(values: FloatArray) -> dict[str, float]:
    return {
        "p50": round(float(np.median(values)), 2),
        "p95": round(float(np.percentile(values, 95)), 2),
        "max": round(float(values.max()), 2),
    }


def main() -> None:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-n", type=int, default=200, help="sequences (200)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--turns", action="store_true", help="rotations as well")
    parser.add_argument("-j", "--processes", type=int, help="at once; default: one a core")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    given = parser.parse_args()
    actions = sequences(given.n, given.seed, turns=given.turns)
    moved_m, turned, joints_rad = robosuite_paths(actions)
    jobs = [(mode, i, actions[i], joints_rad) for mode in MODES for i in range(given.n)]
    played: dict[str, list[dict[str, Any]]] = {mode: [] for mode in MODES}
    for done, each in enumerate(in_processes(play, jobs, given.processes), 1):
        played[each["mode"]].append(each)
        print(f"{done}/{len(jobs)}", end="\r", file=sys.stderr, flush=True)
    found: dict[str, Any] = {
        "n": given.n,
        "seed": given.seed,
        "turns": given.turns,
        "robosuite_moved_mm": _spread(np.linalg.norm(moved_m, axis=-1) * 1e3),
        "robosuite_turned_mrad": _spread(np.linalg.norm(turned, axis=-1) * 1e3),
        **{mode: compare(each, moved_m, turned) for mode, each in played.items()},
    }
    text = json.dumps(found, indent=2)
    if given.output:
        given.output.write_text(text + "\n", "utf-8")
    print(text)


if __name__ == "__main__":
    main()
