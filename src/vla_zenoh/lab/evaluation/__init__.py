"""What became of runs: figures of our recordings and of the thesis's CSV files alike.

`files.evaluate` reads what it is given, `csv_file` and `run_file` make a `result.Evaluation` each,
`result.overall` one of all of them, and `report` a page with plots.
"""

from __future__ import annotations
