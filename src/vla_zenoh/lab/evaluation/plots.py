"""Plots of a run for the HTML page, as JSON for plotly's JavaScript; the page colours them."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.evaluation.result import Evaluation
from vla_zenoh.lab.evaluation.timelines import (
    COLOURS,
    COMMANDED,
    MEASURED,
    Panel,
    bar_width_s,
    panels,
    thinned,
    unbroken,
)
from vla_zenoh.types import FloatArray

ROW_PX, TOP_PX, MAP_PX, HISTOGRAM_PX = 165, 64, 360, 260
MAX_MARKS = 60


def library() -> str:
    """plotly's JavaScript, for the head of the page."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingExtraError("plotly", "record") from error
    return get_plotlyjs()


def timeline(run: Evaluation) -> str:
    """All curves over the time of the run, one below the other; empty if it has none."""
    shown = panels(run)
    if not shown:
        return ""
    from plotly.subplots import make_subplots

    figure = make_subplots(
        rows=len(shown),
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.3 / len(shown) / 1.4,
        subplot_titles=[_title(panel) for panel in shown],
    )
    for row, panel in enumerate(shown, 1):
        for curve in panel.curves:
            if panel.stacked:
                bars = {"x": _short(curve.t_s), "y": _short(curve.values), "name": curve.name}
                look = {"color": curve.colour, "line": {"width": 0}}
                figure.add_bar(**bars, marker=look, width=bar_width_s(curve), row=row, col=1)
                continue
            figure.add_scatter(
                x=_short(curve.t_s),
                y=_short(curve.values),
                mode="lines",
                name=curve.name,
                line={"color": curve.colour, "width": 5 if curve.halo else 1.4},
                opacity=0.35 if curve.halo else 1.0,
                row=row,
                col=1,
            )
    shapes = [
        _upright(t_s, width=1, dash="dot", color="#8894a0") | {"layer": "below"}
        for t_s, _ in run.marks[:MAX_MARKS]
    ]
    shapes.append(_upright(0.0, width=2, color="#e4572e"))  # the cursor
    for note in figure.select_annotations():  # titles: above their curves, at the left
        note.update(x=0, xanchor="left", font={"size": 12})
    for number, (t_s, prompt) in enumerate(run.marks[:MAX_MARKS], 1):
        figure.add_annotation(
            x=t_s, y=1, yref="paper", yshift=40, text=f"<b>{number}</b>", hovertext=prompt,
            showarrow=False, font={"size": 11}, bordercolor="#8894a0", borderpad=2,
        )  # fmt: skip
    figure.update_xaxes(title_text="time (s)", row=len(shown), col=1)
    height = TOP_PX + ROW_PX * len(shown)
    margin = {"l": 48, "r": 8, "t": TOP_PX, "b": 40}
    figure.update_layout(shapes=shapes, height=height, margin=margin, barmode="stack")
    figure.update_layout(showlegend=False, hovermode="x")
    return _json(figure)


def _upright(t_s: float, **line: Any) -> dict[str, Any]:
    """A line through all curves at a time."""
    place = {"xref": "x", "yref": "paper", "x0": t_s, "x1": t_s, "y0": 0, "y1": 1}
    return {"type": "line", "line": line, **place}


def _title(panel: Panel) -> str:
    words = [f"{panel.title}, {panel.unit}"]
    seen: dict[str, str] = {curve.name: curve.colour for curve in panel.curves}
    words += [f'<span style="color:{colour}"><b>{name}</b></span>' for name, colour in seen.items()]
    return "  ".join([*words, panel.note])


def path(run: Evaluation) -> str:
    """The path of the TCP from above and from the side; empty without one."""
    if run.measured is None:
        return ""
    from plotly.subplots import make_subplots

    views = (("from above", 0, 1), ("from the side", 0, 2))
    figure = make_subplots(rows=1, cols=2, subplot_titles=[name for name, *_ in views])
    traces = [(run.measured, "measured", MEASURED, 1.6)]
    if run.commanded is not None:
        traces.insert(0, (run.commanded, "commanded", COMMANDED, 5.0))
    for column, (_, across, up) in enumerate(views, 1):
        for trace, name, colour, width in traces:
            _, points = thinned(*unbroken(trace))
            figure.add_scatter(
                x=_short(points[:, across]),
                y=_short(points[:, up]),
                mode="lines",
                name=name,
                showlegend=column == 1,
                line={"color": colour, "width": width},
                opacity=0.4 if name == "commanded" else 1.0,
                row=1,
                col=column,
            )
        letters = "xyz"
        figure.update_xaxes(title_text=f"{letters[across]} (m)", row=1, col=column)
        anchor = "x" if column == 1 else "x2"
        figure.update_yaxes(title_text=f"{letters[up]} (m)", scaleanchor=anchor, row=1, col=column)
    for note in figure.select_annotations():
        note.update(font={"size": 12})
    legend = {"orientation": "h", "y": -0.25, "x": 0}
    figure.update_layout(height=MAP_PX, legend=legend, margin={"l": 55, "r": 8, "t": 30, "b": 40})
    return _json(figure)


def histogram(run: Evaluation) -> str:
    """The distribution of the end-to-end latency; empty without one."""
    values = run.stages_ms.get("end_to_end", np.zeros(0))
    values = values[np.isfinite(values)]
    if not len(values):
        return ""
    import plotly.graph_objects as go

    figure = go.Figure(go.Histogram(x=_short(values), nbinsx=40, marker={"color": COLOURS[2]}))
    for share, shift, anchor in ((50, 2, "right"), (95, 2, "left")):
        at_ms = float(np.percentile(values, share))
        text = {"text": f"p{share} {at_ms:.0f} ms", "yref": "paper", "y": 1, "yshift": 8}
        look = {"width": 1.5, "dash": "dash", "color": "#e4572e"}
        figure.add_vline(x=at_ms, line=look, annotation=text | {"xanchor": anchor, "xshift": shift})
    figure.update_xaxes(title_text="ms")
    figure.update_yaxes(title_text="requests")
    margin = {"l": 48, "r": 8, "t": 30, "b": 40}
    figure.update_layout(height=HISTOGRAM_PX, bargap=0.05, showlegend=False, margin=margin)
    return _json(figure)


def _json(figure: Any) -> str:
    """Safe inside a script element: a prompt may contain its end."""
    figure.update_layout(template=None)
    return figure.to_json().replace("<", "\\u003c")


def _short(values: FloatArray) -> FloatArray:
    return np.round(values, 4)
