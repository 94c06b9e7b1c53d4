"""Plots of a run for the HTML page, as JSON for plotly's JavaScript."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.evaluation.result import STAGES, Evaluation, PlotTrace
from vla_zenoh.types import FloatArray

MAX_POINTS = 1200
AXES = ("x", "y", "z")
COLOURS = ("#d62728", "#2ca02c", "#1f77b4")
MEASURED, COMMANDED, FLOOR = "#1f77b4", "#ff7f0e", "#9aa5b1"
STAGE_COLOURS = {"outbound": "#4c9be8", "inference": "#f2a541", "inbound": "#6bbf59"}
LAYOUT: dict[str, Any] = {
    "template": "plotly_white",
    "margin": {"l": 60, "r": 15, "t": 40, "b": 40},
    "legend": {"orientation": "h", "y": -0.2, "yanchor": "top", "x": 0},
    "font": {"family": "system-ui, sans-serif", "size": 12},
}


def library() -> str:
    """plotly's JavaScript, for the head of the page.

    Raises:
        MissingExtraError: plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingExtraError("plotly", "record") from error
    return get_plotlyjs()


def plots_of(run: Evaluation) -> list[str]:
    """All plots that the run has figures for, as JSON that is safe inside a script element."""
    made = (
        _path(run),
        _position(run),
        _orientation(run),
        _timeline(run),
        _histogram(run),
        _width(run),
    )
    # A prompt may contain the end of the script element; JSON can escape it.
    return [figure.to_json().replace("<", "\\u003c") for figure in made if figure is not None]


def _figure(title: str, height: int = 330, **layout: Any) -> Any:
    import plotly.graph_objects as go

    return go.Figure(
        layout={
            **LAYOUT,
            "title": {"text": title, "x": 0.01, "font": {"size": 14}},
            "height": height,
            **layout,
        }
    )


def _thin(trace: PlotTrace) -> PlotTrace:
    step = max(1, -(-len(trace.t_s) // MAX_POINTS))
    return PlotTrace(
        *(_short(getattr(trace, name)[::step]) for name in PlotTrace.__dataclass_fields__)
    )


def _short(values: FloatArray) -> FloatArray:
    return np.round(values, 5)


def _path(run: Evaluation) -> Any:
    if run.measured is None:
        return None
    import plotly.graph_objects as go

    figure = _figure("TCP path and its shadow", 430)
    traces = [("measured" if run.commanded else "pose", MEASURED, 4, _thin(run.measured))]
    if run.commanded is not None:
        traces.insert(0, ("commanded", COMMANDED, 7, _thin(run.commanded)))
    low = np.nanmin(np.vstack([trace.position_m for *_, trace in traces]), axis=0)
    high = np.nanmax(np.vstack([trace.position_m for *_, trace in traces]), axis=0)
    half = max(float((high - low).max()) / 2, 0.03) * 1.15
    middle = (low + high) / 2
    floor_m = float(middle[2] - half)
    for name, colour, width, trace in traces:
        x, y, z = trace.position_m.T
        opacity = 0.5 if name == "commanded" else 1.0
        line = {"color": colour, "width": width}
        figure.add_trace(
            go.Scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=line, opacity=opacity)
        )
    x, y, _ = traces[-1][-1].position_m.T
    shadow = {"color": FLOOR, "width": 3}
    figure.add_trace(
        go.Scatter3d(x=x, y=y, z=np.full(len(x), floor_m), mode="lines", name="floor", line=shadow)
    )
    ends = traces[-1][-1].position_m
    ends = ends[np.isfinite(ends).all(axis=1)][[0, -1]]
    figure.add_trace(
        go.Scatter3d(
            x=ends[:, 0],
            y=ends[:, 1],
            z=ends[:, 2],
            mode="markers+text",
            text=["start", "end"],
            marker={"size": 4, "color": "black"},
            showlegend=False,
        )
    )
    figure.update_layout(
        legend={"y": 0.0},
        margin={"l": 0, "r": 0, "b": 0},
        scene={
            "aspectmode": "cube",
            **{
                f"{axis}axis": {
                    "title": {"text": f"{axis} (m)"},
                    "range": [float(middle[index] - half), float(middle[index] + half)],
                }
                for index, axis in enumerate(AXES)
            },
        },
    )
    return figure


def _lines(run: Evaluation, title: str, name: str, unit: str) -> Any:
    if run.measured is None or not np.isfinite(getattr(run.measured, name)).any():
        return None
    import plotly.graph_objects as go

    figure = _figure(title, xaxis={"title": {"text": "time (s)"}}, yaxis={"title": {"text": unit}})
    looks = [(run.measured, 1.4, 1.0, "measured" if run.commanded else "")]
    if run.commanded is not None:
        looks.insert(0, (run.commanded, 5.0, 0.35, "commanded"))
    for trace, width, opacity, word in looks:
        thin = _thin(trace)
        values = getattr(thin, name)
        for axis, (letter, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
            figure.add_trace(
                go.Scatter(
                    x=thin.t_s,
                    y=values[:, axis],
                    mode="lines",
                    line={"color": colour, "width": width},
                    opacity=opacity,
                    name=f"{letter} {word}".strip(),
                    legendgroup=word,
                )
            )
    _mark(figure, run)
    return figure


def _mark(figure: Any, run: Evaluation) -> None:
    for t_s, prompt in run.marks[:40]:
        word = prompt.removeprefix("HARD: ")
        figure.add_vline(
            x=t_s,
            line={"color": "gray", "width": 1, "dash": "dot"},
            annotation={"text": word[:30], "textangle": -90, "font": {"size": 9}, "yanchor": "top"},
        )


def _position(run: Evaluation) -> Any:
    title = "position (thick: commanded)" if run.commanded else "position"
    return _lines(run, title, "position_m", "m, base frame")


def _orientation(run: Evaluation) -> Any:
    return _lines(run, "orientation since the start", "rotvec_rad", "rotation vector (rad)")


def _timeline(run: Evaluation) -> Any:
    parts = [stage for stage in STAGE_COLOURS if stage in run.stages_ms]
    if not parts or not len(run.request_t_s):
        return None
    import plotly.graph_objects as go

    figure = _figure(
        "latency of each request",
        xaxis={"title": {"text": "time (s)"}},
        yaxis={"title": {"text": "ms"}},
    )
    for stage in parts:
        figure.add_trace(
            go.Scatter(
                x=_short(run.request_t_s),
                y=_short(run.stages_ms[stage]),
                stackgroup="stages",
                mode="lines",
                line={"width": 0.5, "color": STAGE_COLOURS[stage]},
                name=f"{stage} ({STAGES[stage]})",
            )
        )
    return figure


def _histogram(run: Evaluation) -> Any:
    values = run.stages_ms.get("end_to_end", np.zeros(0))
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    import plotly.graph_objects as go

    figure = _figure(
        "end-to-end latency",
        xaxis={"title": {"text": "ms"}},
        yaxis={"title": {"text": "requests"}},
        bargap=0.05,
        showlegend=False,
    )
    figure.add_trace(go.Histogram(x=_short(values), nbinsx=40, marker={"color": MEASURED}))
    for name, share in (("p50", 50), ("p95", 95)):
        at_ms = float(np.percentile(values, share))
        figure.add_vline(
            x=at_ms,
            line={"color": "black", "dash": "dash"},
            annotation={"text": f"{name} {at_ms:.1f}"},
        )
    return figure


def _width(run: Evaluation) -> Any:
    if not len(run.width_m) or not np.isfinite(run.width_m).any():
        return None
    import plotly.graph_objects as go

    figure = _figure(
        "gripper opening",
        xaxis={"title": {"text": "time (s)"}},
        yaxis={"title": {"text": "mm"}, "rangemode": "tozero"},
        showlegend=False,
    )
    t_s = run.width_t_s
    step = max(1, -(-len(t_s) // MAX_POINTS))
    line = {"color": MEASURED, "width": 1.4}
    figure.add_trace(
        go.Scatter(
            x=_short(t_s[::step]), y=_short(run.width_m[::step] * 1e3), mode="lines", line=line
        )
    )
    return figure
