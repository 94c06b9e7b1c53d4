"""Arrangement of the views in Rerun's window."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import rerun.blueprint as rrb

from vla_zenoh_view import paths

WINDOW_S = 20.0
"""Length of plots, up to the cursor."""
EYE_M, LOOK_AT_M = (1.4, -0.98, 0.86), (0.34, 0.0, 0.3)
BACKGROUND = (22, 25, 31)
GRID_M = 0.1

SHARE_RANGE = (0.0, 105.0)


def blueprint(
    cameras: Collection[str], seen: Mapping[str, Collection[str]], *, widest_mm: float, live: bool
) -> rrb.Blueprint:
    """The blueprint for these cameras.

    Args:
        seen: worker -> cameras that its model uses.
        widest_mm: largest opening of the gripper; NaN: there is none.
    """
    views = _camera_views(cameras, seen)
    above: Any = _scene()
    if views:
        above = rrb.Horizontal(above, rrb.Vertical(*views), column_shares=[4, 5])
    below = rrb.Horizontal(_texts(seen), _plots(widest_mm), column_shares=[4, 5])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[4, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=paths.TIMELINE,
            play_state="following" if live else "playing",
        ),
        auto_views=False,
        auto_layout=False,
    )


def _scene() -> Any:
    return rrb.Spatial3DView(
        origin=paths.WORLD,
        name="Robot: goal green, commanded orange, measured blue, chunk pink",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=True, spacing=GRID_M, color=(90, 96, 110, 90)),
        eye_controls=rrb.EyeControls3D(
            position=EYE_M, look_target=LOOK_AT_M, eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _texts(seen: Collection[str]) -> Any:
    now = rrb.TextDocumentView(origin=paths.NOW, name="Now")
    answers = [
        rrb.TextDocumentView(origin=paths.answer(worker), name=f"{worker} answers")
        for worker in sorted(seen)
    ]
    columns = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["loglevel", "body"])
    log = rrb.TextLogView(origin=paths.EVENTS, name="Events", columns=columns)
    profile = rrb.TextDocumentView(origin=paths.PROFILE, name="Profile")
    upper = rrb.Horizontal(now, rrb.Tabs(*answers)) if answers else now
    return rrb.Vertical(upper, rrb.Tabs(log, profile), row_shares=[4, 5])


def _camera_views(cameras: Collection[str], seen: Mapping[str, Collection[str]]) -> list[Any]:
    """A row of the cameras, and one of what models see."""
    rows: list[Any] = []
    if cameras:
        views = [
            rrb.Spatial2DView(origin=paths.picture(name), name=f"Camera {name}")
            for name in sorted(cameras)
        ]
        rows.append(rrb.Horizontal(*views))
    models = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=paths.seen(worker, name), name=f"{worker} sees {name}")
                for name in sorted(seen[worker])
            ),
            name=worker,
        )
        for worker in sorted(seen)
        if seen[worker]
    ]
    if models:
        rows.append(models[0] if len(models) == 1 else rrb.Tabs(*models))
    return rows


def _plots(widest_mm: float) -> Any:
    wide = (-0.05 * widest_mm, 1.05 * widest_mm)
    gripper = _plot("Gripper, mm: commanded orange, measured blue", paths.GRIPPER, span=wide)
    return rrb.Grid(
        _plot("Latency, ms: all grey, camera blue, model pink", paths.LATENCY),
        _plot("Speed, mm/s: commanded orange, measured blue", paths.SPEED),
        *([] if math.isnan(widest_mm) else [gripper]),
        _plot("Commanded to measured, mm", paths.TRACKING),
        _plot("Speed left by limits, %", paths.BOUNDS, span=SHARE_RANGE),
        _plot("Joints, rad", paths.JOINTS),
        grid_columns=2,
    )


def _plot(name: str, origin: str, *, span: tuple[float, float] | None = None) -> Any:
    window = rrb.VisibleTimeRange(
        paths.TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        time_ranges=[window],
        axis_y=None if span is None else rrb.ScalarAxis(range=span, zoom_lock=True),
        plot_legend=rrb.PlotLegend(visible=False),
    )
