"""Reflexes, jerk, distance from the targets and processor time of several ways, on franka-sim.

    .venv/bin/python scripts/test_franka.py --benchmark [NAME ...]

One row each. A run lasts 20 s; the simulator judges with its limits and its monitoring of the
connection enforced.

- reflexes: motions that the simulator ended;
- ended: after how many seconds, if the motion ended before the targets;
- jerk: the largest of the measured flange, over 20 ms, and its RMS, in m/s^3;
- lag, off: how much later the flange follows the targets, and how far from them it is then (RMS);
- CPU: of all processes of the contestant, of one core.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "franka"), str(Path(__file__).parent)]

from chain import CHAIN_PATIENCE_S, running_chain  # noqa: E402
from contestants import CONTESTANTS  # noqa: E402
from franka_lab import PROFILE  # noqa: E402
from franka_rig import simulator  # noqa: E402
from our_model import BEGAN  # noqa: E402
from target_stream import DURATION_S, RATE_HZ, offsets  # noqa: E402

PYTHONS = {"franka_rs": "FRANKA_RS", "franka_rs_robot": "FRANKA_RS", "aiofranka": "AIOFRANKA"}
"""Contestant -> environment variable with its interpreter; the others run in this one."""
OURS = "vla-zenoh"
WINDOW_S = 0.02
WORDS = 160
LAGS_S = np.arange(0.0, 1.0, 0.005)
BEGIN_S, PATIENCE_S = 1.0, 90.0
MODEL = Path(__file__).with_name("our_model.py")
MOTION = "FRANKA_SIM_MOTION"
WORKER = "workers: [stream]\nmodels: {{stream: {}}}\noptions: {{scripted: null}}\n"
TICKS = os.sysconf("SC_CLK_TCK")


class Run(NamedTuple):
    """What a contestant did: its times (monotonic), why it ended, and its processor time."""

    began_s: float
    ended_s: float
    why: str
    cpu_s: float


def alone(name: str) -> Run:
    """Run a library by itself."""
    python = shlex.split(os.environ.get(PYTHONS.get(name, ""), sys.executable))
    done = subprocess.run(
        [*python, str(Path(__file__).with_name("contestants.py")), name],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
        cwd=Path(__file__).parent,
    )
    said = done.stdout.strip().splitlines()
    if said and said[-1].startswith("{"):
        return Run(**json.loads(said[-1]))
    errors = [line for line in said if "rror" in line] or done.stderr.strip().splitlines()
    return Run(0.0, 0.0, " ".join(errors[-1:]), 0.0)


def ours(folder: Path) -> Run:
    """Worker, command node, arm and router, as ``vla-zenoh up`` starts them."""
    os.environ[BEGAN] = str(folder / "began")
    profile = folder / "lab.yaml"
    text = PROFILE.format(
        address="127.0.0.1",
        endpoint="tcp/127.0.0.1:17447",
        command="joint",
        franka=", hand: false",
        patience_s=CHAIN_PATIENCE_S,
    )
    text = text.replace("worker: scripted", "worker: stream").replace("10,", f"{RATE_HZ},")
    profile.write_text(text + WORKER.format(MODEL))
    with running_chain(folder, profile_file=profile) as chain:
        chain.activate_when_ready()
        time.sleep(BEGIN_S)
        pids = list(chain.host.supervisor.pids().values())
        chain.client.set_prompt("go")
        cpu_s = -sum(map(processor_s, pids))
        time.sleep(DURATION_S)
        cpu_s += sum(map(processor_s, pids))
        why = "" if chain.state() == "active" else str(chain.detail("why"))
        began_s = float((folder / "began").read_text())
        return Run(began_s, began_s + DURATION_S, why, cpu_s)


def processor_s(pid: int) -> float:
    """User and system time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


@contextmanager
def motion_file(folder: Path) -> Iterator[Path]:
    """Where the simulator writes its motion."""
    os.environ[MOTION] = str(folder / "motion.npy")
    yield folder / "motion.npy"
    del os.environ[MOTION]


def judge(name: str, run: Run, motion: np.ndarray, reflexes: int, share: float) -> str:
    """One row of the table."""
    why = " ".join(run.why.split())[:WORDS]
    motion = motion[(motion[:, 0] > run.began_s) & (motion[:, 0] < run.ended_s)]
    if len(motion) < 1000:
        return f"| {name} | {reflexes} | did not run: {why} | | | | | |"
    time_s = np.arange(0.0, motion[-1, 0] - motion[0, 0], WINDOW_S)
    flange = np.stack(
        [np.interp(time_s, motion[:, 0] - motion[0, 0], column) for column in motion.T[1:]], 1
    )
    jerk = np.linalg.norm(np.diff(flange, 3, axis=0), axis=1) / WINDOW_S**3
    number = int(DURATION_S * RATE_HZ) + 2
    targets = np.stack([offset for offset, _ in zip(offsets(), range(number), strict=False)])
    due_s = np.arange(number) / RATE_HZ
    off = [_off(time_s - lag_s, flange - flange[0], due_s, targets) for lag_s in LAGS_S]
    best = int(np.argmin(off))
    lasted_s = run.ended_s - run.began_s
    ended = f"{lasted_s:.1f} s: {why}" if lasted_s < DURATION_S - 1 else "-"
    return (
        f"| {name} | {reflexes} | {ended} | {jerk.max():.0f} | {np.sqrt(np.mean(jerk**2)):.1f} | "
        f"{1e3 * LAGS_S[best]:.0f} | {1e3 * off[best]:.1f} | {run.cpu_s / lasted_s:.2f} | "
        f"{share:.2f} |"
    )


def _off(time_s: np.ndarray, gone: np.ndarray, due_s: np.ndarray, targets: np.ndarray) -> float:
    wanted = np.stack([np.interp(time_s, due_s, column) for column in targets.T], 1)
    return float(np.sqrt(np.mean(np.sum((gone - wanted) ** 2, axis=1))))


def main(names: list[str]) -> None:
    """Run each contestant on a simulator of its own."""
    print("| way | reflexes | ended | jerk | RMS | lag, ms | off, mm | CPU | real-time share |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in names or [OURS, *CONTESTANTS]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            with motion_file(folder) as file, simulator("--no-gripper") as robot:
                run = ours(folder) if name == OURS else alone(name)
                robot.process.send_signal(signal.SIGUSR2)
                give_up_s = time.monotonic() + 5.0
                while not file.exists() and time.monotonic() < give_up_s:
                    time.sleep(0.1)
                share, reflexes = robot.realtime_share(), len(robot.aborts())
                print(judge(name, run, np.load(file), reflexes, share), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
