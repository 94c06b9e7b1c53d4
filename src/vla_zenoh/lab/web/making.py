"""Makes the page or the film of a run: ``python -m vla_zenoh.lab.web.making KIND RUN OUT``.

Prints the share that is done on lines of its own, and at a fault why.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from vla_zenoh.errors import RecordingError, VlaZenohError

REPORT, FILM = "report", "film"
NICENESS, PICTURES, EVERY = 10, 8, 15


def main(kind: str, run: Path, out: Path, *, pictures: bool) -> None:
    """Make it. Raises RecordingError: the run cannot be read, or has no pictures."""
    if kind == FILM:
        from vla_zenoh.lab.recording.film import Film, write_film
        from vla_zenoh.lab.recording.run import load_run

        def told(done: int, total: int) -> None:
            if done % EVERY == 0:
                print(f"{done / total:.2f}", flush=True)

        if not write_film(out, load_run(run), Film(), progress=told):
            raise RecordingError(f"{run.name} has no pictures of cameras")
        return
    from vla_zenoh.lab.evaluation.evaluate import evaluate
    from vla_zenoh.lab.evaluation.report import page

    runs, faults = evaluate([run], pictures=PICTURES if pictures else 0)
    if not runs:
        raise RecordingError("; ".join(faults.values()))
    out.write_text(page(runs, faults), "utf-8")


if __name__ == "__main__":
    os.nice(NICENESS)
    try:
        main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), pictures="--pictures" in sys.argv)
    except VlaZenohError as error:
        sys.exit(str(error))
