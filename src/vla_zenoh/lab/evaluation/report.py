"""HTML page with tables and plots, in one file without network access."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from vla_zenoh import __version__
from vla_zenoh.errors import MissingExtraError
from vla_zenoh.lab.evaluation import plots
from vla_zenoh.lab.evaluation.evaluate import combined
from vla_zenoh.lab.evaluation.result import STAGES, CameraView, Evaluation
from vla_zenoh.lab.evaluation.tables import LATENCY_COLUMNS, figures, latency_rows, segment_rows

TEMPLATE = "report.html.j2"


def page(runs: Sequence[Evaluation], faults: Mapping[str, str]) -> str:
    """The whole page.

    Raises:
        MissingExtraError: plotly or jinja2 is not installed.
    """
    try:
        from jinja2 import Environment
        from markupsafe import Markup
    except ImportError as error:
        raise MissingExtraError("jinja2", "record") from error
    text = files("vla_zenoh.lab.evaluation").joinpath(TEMPLATE).read_text("utf-8")
    template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(text)
    shown = [combined(runs), *runs] if len(runs) > 1 else list(runs)
    return template.render(
        version=__version__,
        library=Markup(plots.library()),
        faults=faults,
        stages=STAGES,
        latency_columns=LATENCY_COLUMNS,
        runs=[_shown(run, Markup) for run in shown],
    )


def _shown(run: Evaluation, markup: Any) -> dict[str, Any]:
    return {
        "name": run.name,
        "file": run.path.name if run.path else "",
        "problems": run.problems,
        "figures": figures(run),
        "latency": latency_rows(run),
        # The combined run would repeat every prompt.
        "segments": segment_rows(run) if run.path else [],
        "plots": [markup(plot) for plot in plots.plots_of(run)],
        "strips": _strips(run.views),
        "refusals": dict(run.refusals.most_common()),
    }


def _strips(views: Sequence[CameraView]) -> list[dict[str, Any]]:
    """Rows of images: one per camera, and one of the model's inputs from it."""
    rows: dict[tuple[str, bool], list[dict[str, str]]] = {}
    for view in views:
        source = f"data:image/jpeg;base64,{b64encode(view.jpeg).decode()}"
        rows.setdefault((view.camera, view.model), []).append(
            {"time": f"{view.t_s:.1f} s", "source": source}
        )
    return [
        {"title": f"{camera}, as the model was given it" if model else camera, "pictures": found}
        for (camera, model), found in rows.items()
    ]
