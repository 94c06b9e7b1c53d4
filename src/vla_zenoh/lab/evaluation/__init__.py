"""Evaluation of recorded runs.

`evaluate.evaluate` makes a `result.Evaluation` of each file, `evaluate.combined` one of all
of them, and `report` a page with plots.
"""

from __future__ import annotations
