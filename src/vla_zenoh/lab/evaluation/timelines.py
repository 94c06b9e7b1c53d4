"""Curves of a run over time, for the page and for the picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vla_zenoh.lab.evaluation.result import Evaluation, PlotTrace
from vla_zenoh.lab.statistics import distribution
from vla_zenoh.types import FloatArray

MAX_POINTS = 1500
COLOURS = ("#d64541", "#2e9e5b", "#2f7fd0")
"""Of x, y and z."""
MEASURED, COMMANDED = "#2f7fd0", "#f0932b"
STAGES = (("outbound", "#5aa9e6"), ("inference", "#e056a0"), ("inbound", "#f2b134"))
BROAD = "(broad: commanded)"
"""For the first panel; titles have to fit on a phone."""
JUMP_M, GAP_S = 0.05, 0.25
"""From one sample to the next: the simulator was reset, or the stream was interrupted."""


class Curve(NamedTuple):
    """One curve.

    Args:
        colour: ``#rrggbb``.
        t_s: (n,) since the run began.
        values: (n,).
    """

    name: str
    colour: str
    t_s: FloatArray
    values: FloatArray
    halo: bool = False


class Panel(NamedTuple):
    """Curves on one axis. `unit`: of the axis."""

    title: str
    unit: str
    curves: Sequence[Curve]
    stacked: bool = False
    note: str = ""


def panels(run: Evaluation) -> list[Panel]:
    """Panels for which the run has figures."""
    found = [
        _axes(run, "position", "m", "position_m"),
        _axes(run, "rotation since the start", "rad", "rotvec_rad"),
        _speed(run),
        _gripper(run),
        _latency(run),
    ]
    return [panel for panel in found if panel is not None and panel.curves]


def _axes(run: Evaluation, title: str, unit: str, name: str) -> Panel | None:
    curves: list[Curve] = []
    for trace, halo in ((run.commanded, True), (run.measured, False)):
        if trace is None or not np.isfinite(getattr(trace, name)).any():
            continue
        t_s, values = thinned(*unbroken(trace, name))
        curves += [
            Curve(letter, colour, t_s, values[:, axis], halo)
            for axis, (letter, colour) in enumerate(zip("xyz", COLOURS, strict=True))
        ]
    both = run.commanded is not None and run.measured is not None
    return Panel(title, unit, curves, note=BROAD if both and name == "position_m" else "")


def _speed(run: Evaluation) -> Panel | None:
    curves: list[Curve] = []
    both = run.commanded is not None and run.measured is not None
    traces = (("commanded", COMMANDED, run.commanded), ("measured", MEASURED, run.measured))
    for name, colour, trace in traces:
        if trace is not None and len(trace.speed_m_s):
            t_s, values = thinned(*unbroken(trace, "speed_m_s"))
            halo = both and name == "commanded"
            curves.append(Curve(name, colour, t_s, values * 1e3, halo))
    return Panel("speed of the TCP", "mm/s", curves)


def _gripper(run: Evaluation) -> Panel | None:
    if not len(run.width_m) or not np.isfinite(run.width_m).any():
        return None
    t_s, values = thinned(run.width_t_s, run.width_m)
    return Panel("gripper opening", "mm", [Curve("measured", MEASURED, t_s, values * 1e3)])


def _latency(run: Evaluation) -> Panel | None:
    if not len(run.request_t_s):
        return None
    curves = [
        Curve(name, colour, run.request_t_s, np.maximum(run.stages_ms[name], 0.0))
        for name, colour in STAGES
        if name in run.stages_ms
    ]
    found = distribution(run.stages_ms.get("end_to_end", ()))
    note = f"p50 {found.p50:.0f}, p95 {found.p95:.0f}, max {found.max:.0f}" if found else ""
    return Panel("latency of each request", "ms", curves, stacked=True, note=note)


def bar_width_s(curve: Curve) -> float:
    """Width of the bars of a stacked curve: most of the time between two."""
    apart_s = np.diff(curve.t_s)
    apart_s = apart_s[np.isfinite(apart_s) & (apart_s > 0)]
    return 0.8 * float(np.median(apart_s)) if len(apart_s) else 0.1


def unbroken(trace: PlotTrace, name: str = "position_m") -> tuple[FloatArray, FloatArray]:
    """Times and values with NaN where the arm was put elsewhere, or the stream was interrupted."""
    values = getattr(trace, name)
    apart_m = np.linalg.norm(np.diff(trace.position_m, axis=0), axis=1)
    breaks = np.flatnonzero((apart_m > JUMP_M) | (np.diff(trace.t_s) > GAP_S)) + 1
    return np.insert(trace.t_s, breaks, np.nan), np.insert(values, breaks, np.nan, axis=0)


def thinned(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """At most `MAX_POINTS` of them, and all breaks."""
    step = max(1, -(-len(t_s) // MAX_POINTS))
    kept = np.isnan(t_s) | (np.arange(len(t_s)) % step == 0)
    return t_s[kept], values[kept]
