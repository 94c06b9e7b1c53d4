"""Evaluation of recorded runs, and of the CSV of the thesis this package grew from.

`evaluate.evaluate` makes a `result.Evaluation` of each file, `evaluate.combined` one of all
of them, and `report` a page with plots.
"""

from __future__ import annotations
