"""How steadily an arm moves when the same step is requested again and again.

    python -m benchmarks.steady_motion [--perfect] [--plot FILE.png] [-o FILE]

The scripted model asks for 50 steps of 0.01 m and of 0.05 rad, at several rates, in chunks of
several lengths; an inference takes 140 ms, with and without jitter; a step lasts one period, or
0.1 s. All in lockstep. One row each:

- ripple: (greatest - least) / mean of the commanded speed, between 20 % and 80 % of the distance;
- jerk: RMS there, in m/s^3 or rad/s^3;
- reached: of what was asked, by the measured TCP;
- off: how far the command ever is from its axis, in mm and mrad;
- lag: how much later than the goal in force the command covers a distance, mean of 20 % to 80 %.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from benchmarks.lockstep_arm import LOOK_S, activated, in_processes
from benchmarks.motion.segments import make_segment
from vla_zenoh.kinematics.so3 import log3, rotation_from_quat
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile

STEPS = 50
RATES_HZ, HORIZONS, JITTERS = (2.0, 5.0, 10.0), (1, 4, 8), (0.0, 0.3)
INFERENCE_S, CAMERA_S, WIRE_S = 0.14, 0.015, 0.0005
STEP_S = 0.1
PROMPTS = {"HARD: go up": "", "HARD: yaw left": "HARD: go up x20"}
"""Prompt -> the one that first brings the arm to where it can be executed."""
STEADY = (0.2, 0.8)
SETTLE_S, SLACK_S = 1.0, 5.0
PLACES = 61
PLOTTED = ((5.0, 1, 0.3, 0.2), (5.0, 1, 0.3, 0.1), (2.0, 4, 0.3, 0.5), (10.0, 8, 0.3, 0.1))


class Row(NamedTuple):
    """One row: its conditions.

    Args:
        prompt: of the scripted model.
        rate_hz: chunks a second.
        horizon: steps in one.
        jitter: share by which an inference varies.
        dt_s: of a step.
    """

    prompt: str
    rate_hz: float
    horizon: int
    jitter: float
    dt_s: float


def all_rows() -> list[Row]:
    """The whole table."""
    return [
        Row(prompt, rate_hz, horizon, jitter, dt_s)
        for prompt in PROMPTS
        for rate_hz in RATES_HZ
        for dt_s in dict.fromkeys((1.0 / rate_hz, STEP_S))
        for horizon in HORIZONS
        for jitter in JITTERS
    ]


def measure(row: Row, profile_name: str, perfect: bool, traced: bool) -> dict[str, Any]:
    """Run one row; `traced`: with the commanded speed, for a plot."""
    options = {"horizon": str(row.horizon), "dt_s": str(row.dt_s)}
    loop = activated(
        load_profile(profile_name),
        make_policy(find_model("scripted"), options),
        Delays(INFERENCE_S, row.jitter, CAMERA_S, wire_s=WIRE_S),
        row.rate_hz,
        seed=1,
        perfect=perfect,
    )
    loop.run(LOOK_S)
    if PROMPTS[row.prompt]:
        loop.put("rate", 10.0)
        _carry_out(loop, PROMPTS[row.prompt], 20 * max(row.dt_s, 0.1))
        loop.put("rate", row.rate_hz)
        loop.run(LOOK_S)
    since, before = len(loop.trace.time_ns), loop.world.tcp()
    ended = _carry_out(
        loop, f"{row.prompt} x{STEPS}", STEPS * max(row.dt_s / row.horizon, 1 / row.rate_hz)
    )
    return {**row._asdict(), **_figures(loop, since, before, row, traced), "ended": ended}


def _carry_out(loop: Lockstep, prompt: str, expected_s: float) -> bool:
    commander = loop.commander
    episode = commander.task.episode
    loop.put("prompt", prompt)
    ended = loop.run_until(
        lambda: commander.task.episode != episode and commander.progress.done and commander.at_rest,
        2 * expected_s + SLACK_S,
    )
    loop.run(SETTLE_S)
    return ended


def _figures(loop: Lockstep, since: int, before: Any, row: Row, traced: bool) -> dict[str, Any]:
    trace = loop.trace
    sent = [
        (time_ns, command)
        for time_ns, command in zip(trace.time_ns[since:], trace.commands[since:], strict=True)
        if command is not None
    ]
    time_s = np.array([(time_ns - trace.time_ns[since]) / 1e9 for time_ns, _ in sent])
    segment = make_segment(f"{row.prompt} x{STEPS}", STEPS)
    motion = segment.motion
    assert motion is not None
    turns = motion.axis >= 3
    along = np.zeros(3)
    along[motion.axis % 3] = np.sign(motion.step)
    asked = STEPS * abs(motion.step)
    part = slice(3, 6) if turns else slice(0, 3)
    position_m, rotation = before
    moved = np.array([command.position_m - position_m for _, command in sent])
    turned = _turned([rotation_from_quat(command.quat_xyzw) for _, command in sent], rotation)
    goal_m = np.array([command.goal_position_m - position_m for _, command in sent])
    goal_turned = _turned([rotation_from_quat(c.goal_quat_xyzw) for _, c in sent], rotation)
    way = (turned if turns else moved) @ along
    goal = (goal_turned if turns else goal_m) @ along
    spin = np.array([command.twist[part] for _, command in sent])
    change = np.array([command.acceleration[part] for _, command in sent])
    speed = np.linalg.norm(spin, axis=1)
    steady = np.flatnonzero((way >= STEADY[0] * asked) & (way <= STEADY[1] * asked))
    found: dict[str, Any] = {"asked": asked, "unit": "rad" if turns else "m"}
    if len(steady) > 2:
        first, last = steady[0], steady[-1] + 1
        inside = speed[first:last]
        period_s = 1.0 / loop.profile.timing.command_hz
        jerk = np.linalg.norm(np.diff(change[first:last], axis=0), axis=1) / period_s
        places = np.linspace(*STEADY, PLACES) * asked
        late = _times(time_s, way, places) - _times(time_s, goal, places)
        found |= {
            "mean_speed": float(inside.mean()),
            "ripple": float((inside.max() - inside.min()) / inside.mean()),
            "jerk_rms": float(np.sqrt((jerk**2).mean())),
            "lag_s": float(late.mean()),
        }
    off = np.where(along == 0.0, 1.0, 0.0)
    after_m, after = loop.world.tcp()
    reached = log3(after @ rotation.T) if turns else after_m - position_m
    found |= {
        "reached": float(reached @ along),
        "off_mm": 1e3 * float(np.linalg.norm(moved * (1.0 if turns else off), axis=1).max()),
        "off_mrad": 1e3 * float(np.linalg.norm(turned * (off if turns else 1.0), axis=1).max()),
        "took_s": float(time_s[-1] - time_s[0]) - SETTLE_S,
        "state": loop.commander.state.value,
    }
    if traced:
        found["trace"] = [time_s.tolist(), (spin @ along).tolist()]
    return found


def _turned(rotations: Sequence[Any], start: Any) -> Any:
    """(n, 3) rotation vectors from `start`, of angles of more than pi, too."""
    out, last, whole = [], start, np.zeros(3)
    for rotation in rotations:
        whole = whole + log3(rotation @ last.T)
        last = rotation
        out.append(whole)
    return np.array(out)


def _times(time_s: Any, way: Any, places: Any) -> Any:
    """When each place was reached first."""
    furthest = np.maximum.accumulate(way)
    return time_s[np.minimum(np.searchsorted(furthest, places), len(time_s) - 1)]


HEAD = (
    f"{'prompt':15} {'Hz':>4} {'H':>2} {'jit':>4} {'dt_s':>5} {'ripple':>7} {'speed':>7} "
    f"{'jerk':>7} {'reached':>8} {'off mm':>7} {'mrad':>7} {'lag_s':>6} {'took_s':>7}"
)


def line(row: dict[str, Any]) -> str:
    """One row as text."""
    figures = [row.get(name, float("nan")) for name in ("ripple", "mean_speed", "jerk_rms")]
    return (
        f"{row['prompt'].removeprefix('HARD: '):15} {row['rate_hz']:4.0f} {row['horizon']:2d} "
        f"{row['jitter']:4.1f} {row['dt_s']:5.2f} {figures[0]:7.2f} {figures[1]:7.4f} "
        f"{figures[2]:7.3f} {row['reached']:8.4f} {row['off_mm']:7.3f} {row['off_mrad']:7.3f} "
        f"{row.get('lag_s', float('nan')):6.3f} {row['took_s']:7.2f}"
        + ("" if row["ended"] else f"  did not end: {row['state']}")
    )


def plot(rows: list[dict[str, Any]], file: Path) -> None:
    """Commanded speed against time, of the rows that were traced."""
    from matplotlib.figure import Figure

    traced = [row for row in rows if "trace" in row]
    figure = Figure(figsize=(9, 1.8 * len(traced)), layout="constrained")
    for axes, row in zip(np.atleast_1d(figure.subplots(len(traced), 1)), traced, strict=True):
        axes.plot(*row["trace"], linewidth=0.8)
        axes.set_ylabel(f"{row['unit']}/s")
        jitter = f", jitter {row['jitter']:.0%}" if row["jitter"] else ""
        axes.set_title(
            f"{row['prompt']} at {row['rate_hz']:g} Hz, {row['horizon']} steps of "
            f"{row['dt_s']:g} s{jitter}: ripple {row.get('ripple', float('nan')):.2f}",
            fontsize=8,
        )
    axes.set_xlabel("s")
    figure.savefig(file, dpi=110)


def main() -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(description="How steadily an arm moves.")
    parser.add_argument("--profile", default="panda_sim", help="name or path")
    parser.add_argument("--perfect", action="store_true", help="without physics, much faster")
    parser.add_argument("--rate", type=float, action="append", help="only these, in Hz")
    parser.add_argument("--horizon", type=int, action="append", help="only these")
    parser.add_argument("--jobs", type=int, help="at a time; else one a core")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="all rows")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="speed against time")
    options = parser.parse_args()
    jobs = [
        (row, options.profile, options.perfect, options.plot is not None and row[1:] in PLOTTED)
        for row in all_rows()
        if (not options.rate or row.rate_hz in options.rate)
        and (not options.horizon or row.horizon in options.horizon)
    ]
    rows = list(in_processes(measure, jobs, options.jobs))
    order = {tuple(job[0]): n for n, job in enumerate(jobs)}
    rows.sort(key=lambda row: order[tuple(row[name] for name in Row._fields)])
    print(HEAD)
    for row in rows:
        print(line(row))
    if options.plot:
        plot(rows, options.plot)
    if options.output:
        kept = [{name: row[name] for name in row if name != "trace"} for row in rows]
        options.output.write_text(json.dumps(kept, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
