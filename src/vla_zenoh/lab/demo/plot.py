"""Plot of a run: path, orientation, speed against its limit, latency."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.kinematics.so3 import log3, rotation_from_quat
from vla_zenoh.profile import Profile
from vla_zenoh.types import LATENCY_STAGES, Cause, FloatArray, PoseState

MAX_POINTS = 4000
AXES = (("x", "tab:red"), ("y", "tab:green"), ("z", "tab:blue"))


def plot_run(
    path: Path,
    profile: Profile,
    poses: Sequence[Any],
    commands: Sequence[Any],
    marks: Sequence[tuple[int, str]],
    first_commands: Sequence[tuple[Cause, int]],
) -> None:
    """Draw a run into a PNG.

    Args:
        path: of the file.
        profile: for limits and names.
        poses: measured, as heard.
        commands: as heard.
        marks: (wall ns, prompt).
        first_commands: see `vla_zenoh.lab.demo.segments.latencies`.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt
    except ImportError as error:
        raise MissingExtraError("matplotlib", "sim") from error
    poses, commands = _thin(poses), _thin(commands)
    if not poses:
        return
    if not commands:  # an arm that takes joints: what its controller holds is the command
        commands = [_Held(entry.received_ns, _held(entry.record)) for entry in poses]
    zero_ns = poses[0].received_ns
    figure = plt.figure(figsize=(13, 9), layout="constrained")
    grid = figure.add_gridspec(3, 3)
    space = figure.add_subplot(grid[0:2, 0], projection="3d")
    position = figure.add_subplot(grid[0, 1:])
    turning = figure.add_subplot(grid[1, 1:], sharex=position)
    delays = figure.add_subplot(grid[2, 0])
    speed = figure.add_subplot(grid[2, 1:], sharex=position)
    measured, commanded = _positions(poses), _positions(commands)
    _draw_path(space, measured, commanded)
    t_measured, t_commanded = _seconds(poses, zero_ns), _seconds(commands, zero_ns)
    for axis, (name, colour) in enumerate(AXES):
        position.plot(t_commanded, commanded[:, axis], color=colour, lw=2.2, alpha=0.35)
        position.plot(t_measured, measured[:, axis], color=colour, lw=0.9, label=name)
    position.set(ylabel="TCP position (m)", title="position: thick commanded, thin measured")
    position.legend(loc="center right", fontsize=8)
    position.margins(y=0.25)
    first = rotation_from_quat(poses[0].record.quat_xyzw)
    thick, thin = (2.2, 0.35), (0.9, 1.0)
    for entries, times, look in ((commands, t_commanded, thick), (poses, t_measured, thin)):
        turns = np.array(
            [log3(rotation_from_quat(entry.record.quat_xyzw) @ first.T) for entry in entries]
        )
        for axis, (_, colour) in enumerate(AXES):
            turning.plot(times, turns[:, axis], color=colour, lw=look[0], alpha=look[1])
    turning.set(ylabel="since start (rad)", title="orientation, rotation vector in the base")
    norms = np.linalg.norm([entry.record.twist[:3] for entry in commands], axis=1)
    speed.plot(t_commanded, norms, color="black", lw=1, label="commanded speed")
    limit = profile.limits.translation.velocity_m_s
    if norms.max() > 0.3 * limit:
        speed.axhline(limit, color="tab:red", ls="--", lw=1, label="limit per axis")
    title = f"speed (limit {limit:g} m/s per axis)"
    speed.set(ylabel="speed (m/s)", xlabel="time (s)", title=title)
    speed.legend(loc="upper right", fontsize=8)
    for axes in (position, turning, speed):
        _draw_marks(axes, marks, zero_ns, labels=axes is position)
        axes.grid(alpha=0.25)
    _draw_latency(delays, first_commands)
    figure.suptitle(f"vla-zenoh run, profile {profile.name}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


class _Held(NamedTuple):
    received_ns: int
    record: Any


def _held(state: PoseState) -> PoseState:
    if state.reference_position_m is None or state.reference_quat_xyzw is None:
        return state
    return PoseState(state.reference_position_m, state.reference_quat_xyzw, state.twist)


def _thin(entries: Sequence[Any]) -> Sequence[Any]:
    return entries[:: max(1, len(entries) // MAX_POINTS)]


def _positions(entries: Sequence[Any]) -> FloatArray:
    return np.array([entry.record.position_m for entry in entries])


def _seconds(entries: Sequence[Any], zero_ns: int) -> FloatArray:
    return np.array([(entry.received_ns - zero_ns) / 1e9 for entry in entries])


def _draw_path(axes: Any, measured: FloatArray, commanded: FloatArray) -> None:
    axes.plot(*commanded.T, color="tab:orange", lw=2.5, alpha=0.5, label="commanded")
    axes.plot(*measured.T, color="tab:blue", lw=1, label="measured")
    low, high = measured.min(axis=0), measured.max(axis=0)
    half = max(float((high - low).max()) / 2, 0.05) * 1.1
    middle = (low + high) / 2
    floor = middle[2] - half
    axes.plot(measured[:, 0], measured[:, 1], floor, color="gray", lw=0.8, alpha=0.6)
    axes.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(middle[2] - half, middle[2] + half),
        xlabel="x (m)",
        ylabel="y (m)",
        zlabel="z (m)",
        title="TCP path",
    )
    axes.tick_params(labelsize=7)
    axes.legend(loc="upper left", fontsize=8)


def _draw_marks(axes: Any, marks: Sequence[tuple[int, str]], zero_ns: int, *, labels: bool) -> None:
    for stamp_ns, prompt in marks:
        at_s = (stamp_ns - zero_ns) / 1e9
        axes.axvline(at_s, color="gray", lw=0.7, alpha=0.6)
        if labels:
            axes.annotate(
                prompt.removeprefix("HARD: "),
                (at_s, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(2, -2),
                textcoords="offset points",
                rotation=90,
                va="top",
                fontsize=7,
                color="dimgray",
            )


def _draw_latency(axes: Any, first_commands: Sequence[tuple[Cause, int]]) -> None:
    axes.set(title="camera stamp to pose command (ms)", xlabel="chunk")
    axes.grid(alpha=0.25)
    if not first_commands:
        return
    names = LATENCY_STAGES[:-1]
    stages_ms = np.array(
        [[cause.latency_ms(stamp_ns)[name] for name in names] for cause, stamp_ns in first_commands]
    )
    labels = [name.replace("_", " ") for name in names]
    below = np.maximum(stages_ms.T, 0)
    axes.stackplot(range(len(stages_ms)), below, labels=labels, alpha=0.8, lw=0)
    axes.set_ylim(0, float(np.percentile(stages_ms.sum(axis=1), 99)) * 1.5)
    axes.legend(loc="upper left", fontsize=7)
