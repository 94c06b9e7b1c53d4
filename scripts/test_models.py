"""Tests of models that need an environment of their own: uv makes it from the model's header.

    .venv/bin/python scripts/test_models.py [MODEL ...] [--require] [--with PACKAGE]
                                            [-- PYTEST OPTIONS]

tests/models/NAME/ runs in the environment of the model NAME, with what its ``requirements.txt``
adds; the files beside those folders run in ./.venv, with workers that have theirs. Without a name
all models are tested, and the adapters. An environment that cannot be had is skipped with uv's
reason; ``--require`` makes that a failure.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from bootstrap import uv_environment

from vla_zenoh.plugins import how_to_repeat
from vla_zenoh.policy.loader import find_model
from vla_zenoh.runtime.environments import environment_command

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests" / "models"
TOOLS = ["pytest>=8.2", "pytest-timeout>=2.3"]
STUCK_S = 280
"""To import torch and start a robot takes longer than the other tests may."""
NOTHING_RAN = 5
"""pytest's exit status when no test was selected."""


def environment(environ: Mapping[str, str]) -> dict[str, str]:
    """Variables for uv and for what it runs."""
    out = uv_environment(environ)
    # A version that pyenv keeps but does not select is as good as any other.
    kept = sorted(Path(environ.get("PYENV_ROOT") or Path.home() / ".pyenv").glob("versions/*/bin"))
    out["PATH"] = os.pathsep.join([out.get("PATH", ""), *map(str, kept)])
    # Tiny networks gain nothing from threads, which only wait for each other.
    out.setdefault("OMP_NUM_THREADS", "1")
    # Nothing is fetched from a model hub.
    out.update(HF_HUB_OFFLINE="1", TRANSFORMERS_OFFLINE="1")
    return out


def run_model(
    name: str, added: list[str], options: list[str], environ: Mapping[str, str]
) -> tuple[str, str]:
    """Verdict and reason of the tests in the environment of the model `name`."""
    extra = TESTS / name / "requirements.txt"
    more = [line for line in extra.read_text().split("\n") if line] if extra.is_file() else []
    command = environment_command(find_model(name), [*TOOLS, *more, *added])
    if name == "lerobot":  # its arm and data sets, too
        for package in (
            "vla-zenoh-lerobot",
            "vla-zenoh-dataset",
            "vla-zenoh-benchmarks",
            "lerobot_robot_vla_zenoh",
        ):
            command += how_to_repeat(package)
    made = subprocess.run(
        [*command, "python", "-c", ""], env=environ, capture_output=True, text=True, check=False
    )
    if made.returncode:
        return "skipped", f"no environment: {made.stderr.strip()[-600:]}"
    return run_tests([*command, "python"], [str(TESTS / name)], options, environ)


def run_tests(
    python: list[str], what: list[str], options: list[str], environ: Mapping[str, str]
) -> tuple[str, str]:
    """Verdict and reason of a run of pytest."""
    # Folders above have fixtures that need the simulator.
    inside = ["--confcutdir", str(TESTS)] if len(python) > 1 else []
    patience = ["-o", f"faulthandler_timeout={STUCK_S}"]
    command = [*python, "-m", "pytest", "-q", "-m", "models", *patience, *inside, *what, *options]
    status = subprocess.run(command, cwd=ROOT, env=environ, check=False).returncode
    if status == NOTHING_RAN:
        return "skipped", "no test was selected"
    return ("failed", "see above") if status else ("passed", "")


def main() -> int:
    """Run everything that is asked for; the exit status."""
    folders = sorted(path.name for path in TESTS.iterdir() if (path / "requirements.txt").exists())
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("models", nargs="*", metavar="MODEL", help=f"of {', '.join(folders)}")
    parser.add_argument("--require", action="store_true", help="no environment is a failure")
    parser.add_argument("--with", dest="added", action="append", default=[], metavar="PACKAGE")
    given = sys.argv[1:]
    split = given.index("--") if "--" in given else len(given)
    asked, options = parser.parse_args(given[:split]), given[split + 1 :]
    unknown = sorted(set(asked.models) - {*folders})
    if unknown:
        parser.error(f"no tests for {', '.join(unknown)}; there are {', '.join(folders)}")
    environ = environment(os.environ)
    verdicts: dict[str, tuple[str, str]] = {}
    for name in asked.models or folders:
        began_s = time.monotonic()
        verdict, why = run_model(name, asked.added, options, environ)
        verdicts[name] = verdict, why or f"in {time.monotonic() - began_s:.0f} s"
    ready = [name for name, (verdict, _) in verdicts.items() if verdict == "passed"]
    chains = [str(path) for name in ready for path in sorted(TESTS.glob(f"test_{name}_*.py"))]
    adapters = [] if asked.models else [str(TESTS / "test_adapters_alone.py")]
    for name, files in (("chains", chains), ("adapters", adapters)):
        if not files:
            continue
        began_s = time.monotonic()
        verdict, why = run_tests([sys.executable], files, options, environ)
        verdicts[name] = verdict, why or f"in {time.monotonic() - began_s:.0f} s"
    print()
    for name, (verdict, why) in verdicts.items():
        print(f"{name}: {verdict} {why}")
    bad = {"failed", "skipped"} if asked.require else {"failed"}
    return int(any(verdict in bad for verdict, _ in verdicts.values()))


if __name__ == "__main__":
    sys.exit(main())
