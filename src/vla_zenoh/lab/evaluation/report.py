"""HTML page with video, tables and plots, in one file without network access."""

from __future__ import annotations

import datetime as dt
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any

from vla_zenoh import __version__
from vla_zenoh.lab.durable import page_language, page_template
from vla_zenoh.lab.evaluation import plots, tables
from vla_zenoh.lab.evaluation.evaluate import combined
from vla_zenoh.lab.evaluation.result import STAGES, CameraView, Evaluation

TEMPLATE = "report.html.j2"
TABLE = """<table><tr>{% for name in columns %}<th{{ "" if loop.first else ' class="n"' | safe }}>\
{{ name }}</th>{% endfor %}</tr>{% for row in rows %}<tr>{% for value in row %}\
<td{{ "" if loop.first else ' class="n"' | safe }}>{{ value }}</td>{% endfor %}</tr>{% endfor %}\
</table>"""


def page(runs: Sequence[Evaluation], faults: Mapping[str, str]) -> str:
    """The whole page. Raises MissingExtraError: plotly or jinja2 is not installed."""
    cells = page_language().from_string(TABLE)
    from markupsafe import Markup

    together = [combined(runs)] if len(runs) > 1 else []
    return page_template("vla_zenoh.lab.evaluation", TEMPLATE).render(
        title=f"Evaluation of {runs[0].name if len(runs) == 1 else f'{len(runs)} runs'}",
        version=__version__,
        made=f"{dt.datetime.now():%Y-%m-%d %H:%M}",
        library=Markup(plots.library()),
        faults=faults,
        hints=tables.HINTS,
        table=lambda columns, rows: Markup(cells.render(columns=columns, rows=rows)),
        latency_columns=("stage", *tables.LATENCY_COLUMNS),
        summary_columns=(*tables.SUMMARY_COLUMNS, "tasks done"),
        summary=[(*tables.summary_row(run), tables.tasks_done(run)) for run in (*runs, *together)],
        runs=[_shown(run, Markup) for run in runs],
    )


def _shown(run: Evaluation, markup: Any) -> dict[str, Any]:
    return {
        "name": run.name,
        "file": run.path.name if run.path else "",
        "about": run.about,
        "verdicts": run.verdicts,
        "problems": run.problems,
        "figures": tables.figures(run),
        "latency": [(f"{row[0]}: {STAGES[row[0]]}", *row[1:]) for row in tables.latency_rows(run)],
        "segments": tables.filled(
            tables.SEGMENT_COLUMNS,
            [
                (f"{number}. {row[0]}", *row[1:])
                for number, row in enumerate(tables.segment_rows(run), 1)
            ],
        ),
        "film": b64encode(run.film).decode(),
        "strips": _strips(run.views),
        "timeline": markup(plots.timeline(run)),
        "histogram": markup(plots.histogram(run)),
        "path": markup(plots.path(run)),
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
