"""Fuzzes every reader of foreign bytes with atheris: ``make fuzz SECONDS=60``.

Each target of ``targets.py`` gets a process and an equal share of the time. Whatever comes out but
an error of ours, takes longer than `PATIENCE_S` or more memory than `MEMORY_MIB` is a crash: its
input is kept in ``corpus/<target>`` and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent
LEAST_S = 2
PATIENCE_S, MEMORY_MIB, ALLOC_MIB = 10, 1536, 768
MAX_INPUT_BYTES = 4096
_DONE = re.compile(r"Done (\d+) runs in (\d+) second")
_COVERED = re.compile(r"cov: (\d+) ft: (\d+)")


def fuzz_one(name: str, seconds: int, seed: int) -> dict[str, object]:
    """Fuzz one target in a process of its own; what was found is a dictionary for JSON."""
    from targets import CORPUS, TARGETS

    with tempfile.TemporaryDirectory(prefix="fuzz-") as made:
        folder = Path(made)
        seeds, found = folder / "seeds", folder / "found"
        seeds.mkdir()
        found.mkdir()
        inputs = TARGETS[name].corpus()
        for number, data in enumerate(inputs):
            (seeds / str(number)).write_bytes(data)
        longest = max(MAX_INPUT_BYTES, *(2 * len(data) for data in inputs))
        command = [
            *(sys.executable, __file__, "--target", name),
            f"-max_total_time={seconds}",
            f"-seed={seed}",
            f"-max_len={longest}",
            f"-timeout={PATIENCE_S}",
            f"-rss_limit_mb={MEMORY_MIB}",
            f"-malloc_limit_mb={ALLOC_MIB}",
            f"-artifact_prefix={found}/",
            "-verbosity=1",
            str(seeds),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        crashes = sorted(found.iterdir())
        kept: list[str] = []
        for crash in crashes:
            (CORPUS / name).mkdir(parents=True, exist_ok=True)
            kept.append(str(shutil.copy(crash, CORPUS / name / crash.name)))
    said = done.stdout + done.stderr
    runs, covered = _DONE.search(said), _COVERED.findall(said)
    failed = bool(kept) or done.returncode != 0 or runs is None
    return {
        "target": name,
        "runs": int(runs[1]) if runs else None,
        "edges": int(covered[-1][0]) if covered else 0,
        "crashes": kept,
        "why": said[-3000:] if failed else "",
    }


def be_fuzzed(name: str, options: list[str]) -> None:
    """In the child: hand the target to libFuzzer, which does not come back."""
    import atheris

    with atheris.instrument_imports(include=["vla_zenoh", "mcap", "rosbags", "yaml", "msgpack"]):
        from targets import TARGETS
    target = TARGETS[name]
    atheris.Setup([sys.argv[0], *options], target.try_)
    atheris.Fuzz()


def main() -> int:
    """Fuzz all targets, or those that were named; 1: something broke."""
    parser = argparse.ArgumentParser(description="Fuzz the readers of foreign bytes.")
    parser.add_argument("--seconds", type=int, default=60, help="for all targets together")
    parser.add_argument("--seed", type=int, default=0, help="0: another one each time")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("names", nargs="*", help="targets; none: all")
    asked = parser.parse_args()
    try:
        import atheris  # noqa: F401
    except ImportError:
        print(
            "atheris is not installed: it has wheels for Linux on x86-64 with CPython 3.11 to "
            "3.13 only. Elsewhere: HYPOTHESIS_PROFILE=thorough python -m pytest tests/fuzz",
            file=sys.stderr,
        )
        return 2
    from targets import TARGETS

    unknown = [name for name in asked.names if name not in TARGETS]
    if unknown:
        parser.error(f"no target {', '.join(unknown)}; there are: {', '.join(TARGETS)}")
    names = asked.names or list(TARGETS)
    share = max(LEAST_S, round(asked.seconds * asked.jobs / len(names)))
    seed = asked.seed or int.from_bytes(os.urandom(3), "big") + 1
    with ThreadPoolExecutor(asked.jobs) as pool:
        results = list(pool.map(lambda name: fuzz_one(name, share, seed), names))
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
    sys.path.insert(0, str(HERE))
    if len(sys.argv) > 2 and sys.argv[1] == "--target":
        be_fuzzed(sys.argv[2], sys.argv[3:])
    sys.exit(main())
