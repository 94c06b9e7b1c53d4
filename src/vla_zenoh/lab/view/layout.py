"""Arrangement of the views in Rerun's window."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import rerun.blueprint as rrb

from vla_zenoh.lab.view import paths

WINDOW_S = 20.0
"""Length of plots, up to the cursor."""
EYE_M, LOOK_AT_M = (1.4, -0.98, 0.86), (0.34, 0.0, 0.3)
BACKGROUND = (22, 25, 31)
GRID_M = 0.1

SHARE_RANGE = (0.0, 105.0)


def blueprint(
    cameras: Collection[str],
    seen: Mapping[str, Collection[str]],
    *,
    widest_mm: float,
    live: bool,
) -> rrb.Blueprint:
    """The blueprint for these cameras.

    Args:
        cameras: of the robot.
        seen: worker -> cameras that its model uses.
        widest_mm: largest opening of the gripper.
        live: follow the newest data.
    """
    left = rrb.Vertical(_scene(), _texts(), row_shares=[3, 1])
    pictures, plots = _pictures(cameras, seen), _plots(widest_mm)
    right = rrb.Vertical(*pictures, plots, row_shares=_shares(cameras, seen))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1, 1]),
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


def _texts() -> Any:
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    log = rrb.TextLogView(origin=paths.EVENTS, name="Events", columns=columns)
    now = rrb.TextDocumentView(origin=paths.NOW, name="Now")
    profile = rrb.TextDocumentView(origin=paths.PROFILE, name="Profile")
    return rrb.Horizontal(now, rrb.Tabs(log, profile), column_shares=[2, 3])


def _pictures(cameras: Collection[str], seen: Mapping[str, Collection[str]]) -> list[Any]:
    rows: list[Any] = []
    if cameras:
        rows.append(
            rrb.Horizontal(
                *(
                    rrb.Spatial2DView(origin=paths.picture(name), name=f"Camera {name}")
                    for name in sorted(cameras)
                )
            )
        )
    models = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=paths.seen(worker, name), name=f"{worker} sees {name}")
                for name in sorted(seen[worker])
            ),
            rrb.TextDocumentView(origin=paths.answer(worker), name=f"{worker} answers"),
            name=worker,
        )
        for worker in sorted(seen)
    ]
    if models:
        rows.append(models[0] if len(models) == 1 else rrb.Tabs(*models))
    return rows


def _shares(cameras: Collection[str], seen: Mapping[str, Collection[str]]) -> list[float]:
    of_models = 4.0 if any(seen.values()) else 2.0
    return [*([5.0] if cameras else []), *([of_models] if seen else []), 7.0]


def _plots(widest_mm: float) -> Any:
    wide = (-0.05 * widest_mm, 1.05 * widest_mm)
    return rrb.Grid(
        _plot("Latency, ms", paths.LATENCY),
        _plot("Speed of the TCP, mm/s", paths.SPEED),
        _plot("Gripper, mm", paths.GRIPPER, span=wide),
        _plot("Commanded to measured, mm", paths.TRACKING, legend=False),
        _plot("Speed left by bounds, %", paths.BOUNDS, span=SHARE_RANGE, legend=False),
        _plot("Joints, rad", paths.JOINTS, legend=False),
        grid_columns=2,
    )


def _plot(
    name: str, origin: str, *, span: tuple[float, float] | None = None, legend: bool = True
) -> Any:
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
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )
