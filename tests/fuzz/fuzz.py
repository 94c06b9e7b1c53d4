"""Fuzzes every reader of foreign bytes with atheris: ``make fuzz SECONDS=60``.

Each target of ``targets.py`` gets a process and an equal share of the time. Whatever comes out but
an error of ours, takes longer than `PATIENCE_S` or more memory than `MEMORY_MIB` is a crash: its
input is kept in ``corpus/<target>`` and the exit code is 1. The same command with ``--seed`` tries
the same again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import tempfile
from collections import deque
from pathlib import Path
from typing import NoReturn

try:
    import atheris
except ImportError:
    sys.exit(
        "atheris is not installed: it has wheels for Linux on x86-64 with CPython 3.11 to 3.13 "
        "only. Elsewhere: HYPOTHESIS_PROFILE=thorough python -m pytest tests/fuzz"
    )

sys.path.append(str(Path(__file__).parents[1]))  # model_wires
MODELS = ("groot", "lerobot_server", "openpi", "openvla_rest", "origami", "xpolicylab")
# What is imported here counts which of its branches are taken: that is what guides the fuzzer.
with atheris.instrument_imports(
    include=["vla_zenoh", *(f"vla_zenoh_model_{name}" for name in MODELS), "mcap", "rosbags"],
    exclude=["vla_zenoh.simulation"],
):
    from targets import CORPUS, TARGETS, Target

LEAST_S = 2
PATIENCE_S, MEMORY_MIB, ALLOC_MIB = 30, 1536, 768
MAX_INPUT_BYTES = 4096
_DONE = re.compile(r"Done (\d+) runs in (\d+) second")
_COVERED = re.compile(r"cov: (\d+) ft: (\d+)")


class Run:
    """One target being fuzzed in a process of its own, forked off when all is imported.

    Args:
        target: the reader.
        seconds: for how long.
        seed: of libFuzzer.
    """

    def __init__(self, target: Target, seconds: int, seed: int) -> None:
        self.target = target
        self._made = tempfile.TemporaryDirectory(prefix="fuzz-")
        folder = Path(self._made.name)
        seeds, self._found = folder / "seeds", folder / "found"
        self._log = folder / "log"
        seeds.mkdir()
        self._found.mkdir()
        inputs = target.corpus()
        for number, data in enumerate(inputs):
            (seeds / str(number)).write_bytes(data)
        longest = max(MAX_INPUT_BYTES, *(2 * len(data) for data in inputs))
        options = [
            f"-max_total_time={seconds}",
            f"-seed={seed}",
            f"-max_len={longest}",
            f"-timeout={PATIENCE_S}",
            f"-report_slow_units={PATIENCE_S}",
            f"-rss_limit_mb={MEMORY_MIB}",
            f"-malloc_limit_mb={ALLOC_MIB}",
            f"-artifact_prefix={self._found}/",
            str(seeds),
        ]
        sys.stdout.flush()
        self._pid = os.fork()
        if self._pid == 0:
            self._be_fuzzed(options)

    def _be_fuzzed(self, options: list[str]) -> NoReturn:
        """In the child: hand the target to libFuzzer, which ends the process."""
        log = os.open(self._log, os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        try:
            atheris.Setup([sys.argv[0], *options], self.target.try_)
            atheris.Fuzz()
        finally:
            os._exit(70)  # libFuzzer itself ends with 0, or 77 after a crash

    def end(self) -> dict[str, object]:
        """Wait for its end; what was found is a dictionary for JSON, crashes are kept."""
        _, status = os.waitpid(self._pid, 0)
        said = self._log.read_text(errors="replace")
        kept: list[str] = []
        for crash in sorted(self._found.iterdir()):
            folder = CORPUS / self.target.name
            folder.mkdir(parents=True, exist_ok=True)
            kept.append(str(shutil.copy(crash, folder / crash.name)))
        self._made.cleanup()
        runs, covered = _DONE.search(said), _COVERED.findall(said)
        broken = bool(kept) or os.waitstatus_to_exitcode(status) != 0 or runs is None
        return {
            "target": self.target.name,
            "runs": int(runs[1]) if runs else 0,
            "edges": int(covered[-1][0]) if covered else 0,
            "crashes": kept,
            "why": (said[-3000:] or "it ended without a word") if broken else "",
        }


def fuzz_all(names: list[str], seconds: int, seed: int, jobs: int) -> list[dict[str, object]]:
    """Fuzz these targets, so many at a time."""
    waiting, running = list(names), deque[Run]()
    results: list[dict[str, object]] = []
    while waiting or running:
        while waiting and len(running) < jobs:
            running.append(Run(TARGETS[waiting.pop(0)], seconds, seed))
        results.append(running.popleft().end())
    return results


def main() -> int:
    """Fuzz all targets, or those that were named; 1: something broke."""
    parser = argparse.ArgumentParser(description="Fuzz the readers of foreign bytes.")
    parser.add_argument("--seconds", type=int, default=60, help="for all targets together")
    parser.add_argument("--seed", type=int, default=0, help="0: another one each time")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("names", nargs="*", help="targets; none: all")
    asked = parser.parse_args()
    unknown = [name for name in asked.names if name not in TARGETS]
    if unknown:
        parser.error(f"no target {', '.join(unknown)}; there are: {', '.join(TARGETS)}")
    names = asked.names or list(TARGETS)
    share = max(LEAST_S, round(asked.seconds * asked.jobs / len(names)))
    seed = asked.seed or int.from_bytes(os.urandom(3), "big") + 1
    results = fuzz_all(names, share, seed, asked.jobs)
    if asked.json:
        print(json.dumps({"seed": seed, "seconds_each": share, "targets": results}, indent=2))
    else:
        print(f"seed {seed}, {share} s for each target")
        for found in results:
            words = "ok" if not found["why"] else "BROKEN"
            runs, edges = found["runs"] or 0, found["edges"]
            print(f"  {found['target']:<24}{runs:>10,} inputs{edges:>7} edges  {words}")
    broken = [found for found in results if found["why"]]
    for found in broken:
        print(f"\n{found['target']}: {found['crashes']}\n{found['why']}", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
