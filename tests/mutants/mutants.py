"""Puts small faults into the code, one at a time, and tells which of them no test notices.

Every mutant runs in a copy of the tree, with the tests that execute its line, the quickest first.
Which tests those are is measured once and kept in `.tools/mutants/`, as are the results.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
from mutations import Mutant, draw

ROOT = Path(__file__).resolve().parents[2]
MUTATED = [f"src/vla_zenoh/{folder}" for folder in ("control", "guard", "codec", "kinematics")]
TESTS = [f"tests/unit/{folder}" for folder in ("control", "guard", "codec", "kinematics")]
TESTS.append("tests/unit/ros2/test_ros2_messages.py")  # of codec/cdr.py
EQUIVALENT = Path(__file__).with_name("equivalent.txt")
FIRST_TESTS = 15
"""One of each test function; the rest runs only if these pass."""
LIMIT_BYTES = 16 * 2**30
"""Of a process with a mutant that takes more and more memory."""
FORK = multiprocessing.get_context("forkserver")
LIBRARIES = [
    "hypothesis",
    "numpy",
    "pinocchio",
    "pydantic",
    "pytest",
    "coverage",
    "cv2",
    "ruckig",
    "daqp",
]
"""Imported once, for all processes."""

Times = dict[str, float]
"""Test -> seconds."""


class Chosen:
    """A plug-in of pytest: runs these tests in this order, and keeps what fails first."""

    def __init__(self, wanted: list[str]) -> None:
        self._order = {test: number for number, test in enumerate(wanted)}
        self.failed: str | None = None

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._order]
        items.sort(key=lambda item: self._order[item.nodeid])

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.failed = f"import by {report.nodeid}"

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


class Lines:
    """A plug-in of pytest: which lines of the mutated folders each test executes, and how long."""

    def __init__(self, tree: Path, folders: list[str]) -> None:
        import coverage

        self._tree = tree
        include = [f"{tree / folder}/*" for folder in folders]
        self._coverage = coverage.Coverage(data_file=None, include=include, config_file=False)
        self._coverage.start()
        self.seconds: Times = {}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid)
        begins = time.perf_counter()
        yield
        self.seconds[item.nodeid] = round(time.perf_counter() - begins, 3)
        self._coverage.switch_context("")

    def result(self) -> dict[str, Any]:
        self._coverage.stop()
        data = self._coverage.get_data()
        executed: dict[str, dict[str, list[int]]] = {test: {} for test in self.seconds}
        for file in data.measured_files():
            for line, tests in data.contexts_by_lineno(file).items():
                for test in executed.keys() & set(tests):
                    name = Path(file).relative_to(self._tree).as_posix()
                    executed[test].setdefault(name, []).append(line)
        return {"seconds": self.seconds, "executed": executed}


def _pytest(files: list[str], plugin: object) -> int:
    """Run pytest here, quietly, with hypothesis searching for a failure but not a smaller one."""
    from hypothesis import Phase, settings

    phases = [Phase.explicit, Phase.generate]
    settings.register_profile("mutants", deadline=None, derandomize=True, phases=phases)
    os.environ["HYPOTHESIS_PROFILE"] = "mutants"
    flags = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:rerunfailures"]
    flags += ["--rootdir", os.getcwd()]
    flags += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of the libraries imported once
    return int(pytest.main([*flags, *files], plugins=[plugin]))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.killpg(0, signal.SIGKILL)


def _work(end: Connection, root: Path, tree: Path, job: dict[str, Any]) -> None:
    """Of a process of its own: run some tests on the source in `tree`, and send what came out."""
    os.setsid()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.chdir(root)
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(tree / "src"))
    os.environ["PYTHONPATH"] = str(tree / "src")
    output = os.open(f"{tree}.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if "wanted" not in job:
        lines = Lines(tree, job["folders"])
        code = _pytest(job["files"], lines)
        end.send(lines.result() if code in (0, 5) else {})
        return
    chosen = Chosen(job["wanted"])
    code = _pytest(sorted({test.split("::")[0] for test in job["wanted"]}), chosen)
    end.send({"failed": chosen.failed or (None if code in (0, 5) else f"pytest itself ({code})")})


def _processed(root: Path, tree: Path, job: dict[str, Any], limit_s: float) -> dict[str, Any]:
    """What `_work` sends, or how it ended without."""
    here, there = FORK.Pipe(duplex=False)
    process = FORK.Process(target=_work, args=(there, root, tree, job))
    process.start()
    there.close()
    try:
        if not here.poll(limit_s):
            return {"failed": "time limit"}
        return here.recv()
    except EOFError:
        process.join()
        return {"failed": f"end of the process ({process.exitcode})"}
    finally:
        try:
            os.killpg(int(process.pid), signal.SIGKILL)
        except ProcessLookupError:
            process.kill()
        process.join()


@dataclass
class Run:
    root: Path
    folders: list[str]
    tests: list[str]
    jobs: int
    grace_s: float
    budget_s: float
    ends: float
    """Nothing begins after that, in seconds of `time.monotonic`."""
    seconds: Times = field(default_factory=dict)
    by_line: dict[tuple[str, int], set[str]] = field(default_factory=dict)
    """File and line -> tests that execute it."""
    trees: SimpleQueue[Path] = field(default_factory=SimpleQueue)

    @property
    def kept(self) -> Path:
        return self.root / ".tools" / "mutants"

    @contextmanager
    def copies(self) -> Iterator[None]:
        """A copy of the source for each job; all else is linked."""
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            for number in range(self.jobs):
                tree = Path(folder) / str(number)
                tree.mkdir()
                for entry in self.root.iterdir():
                    if entry.name == "src":
                        skipped = shutil.ignore_patterns("__pycache__")
                        shutil.copytree(entry, tree / "src", ignore=skipped)
                    elif not entry.name.startswith("."):
                        (tree / entry.name).symlink_to(entry)
                self.trees.put(tree)
            yield

    def measure(self) -> bool:
        """Learn which tests execute which lines; whether the time sufficed for all."""
        source = [file for part in self.folders for file in (self.root / part).rglob("*.py")]
        before = b"".join(file.read_bytes() for file in sorted(source))
        found = {file for part in self.tests for file in (self.root / part).rglob("test_*.py")}
        found |= {self.root / part for part in self.tests if part.endswith(".py")}
        with ThreadPoolExecutor(self.jobs) as pool:
            done = list(pool.map(lambda file: self._measure(file, before), sorted(found)))
        return all(done)

    def _measure(self, file: Path, before: bytes) -> bool:
        digest = hashlib.sha256(before + file.read_bytes()).hexdigest()[:16]
        kept = self.kept / f"lines-{digest}.json"
        if not kept.exists():
            if time.monotonic() > self.ends:
                return False
            job = {"files": [str(file.relative_to(self.root))], "folders": self.folders}
            tree = self.trees.get()
            result = _processed(self.root, tree, job, 600)
            self.trees.put(tree)
            if "seconds" not in result:
                raise SystemExit(
                    f"{file} fails without a mutant:\n{Path(f'{tree}.txt').read_text()}"
                )
            kept.write_text(json.dumps(result))
        result = json.loads(kept.read_text())
        self.seconds |= result["seconds"]
        for test, files in result["executed"].items():
            for name, lines in files.items():
                for line in lines:
                    self.by_line.setdefault((name, line), set()).add(test)
        return True

    def tests_of(self, mutant: Mutant) -> set[str]:
        """Those that execute its lines; of what an import executes, the lines that name it."""
        name = mutant.file.as_posix()
        found = {t for line in mutant.place.lines for t in self.by_line.get((name, line), ())}
        if found or not mutant.place.assigned:
            return found
        word = re.compile(rf"\b{re.escape(mutant.place.assigned)}\b")
        for file in {file for file, _ in self.by_line}:
            for number, line in enumerate((self.root / file).read_text("utf-8").splitlines(), 1):
                if word.search(line):
                    found |= self.by_line.get((file, number), set())
        return found

    def order(self, tests: set[str]) -> list[list[str]]:
        """The quickest of each function first, then as many of the rest as the budget allows."""
        quickest = sorted(tests, key=lambda test: (self.seconds[test], test))
        of_functions: dict[str, str] = {}
        for test in quickest:
            of_functions.setdefault(test.split("[")[0], test)
        first = list(of_functions.values())[:FIRST_TESTS]
        rest = [*list(of_functions.values())[FIRST_TESTS:]]
        rest += [test for test in quickest if test not in of_functions.values()]
        within, spent = [], 0.0
        for test in rest:
            if spent + self.seconds[test] <= self.budget_s:
                within.append(test)
                spent += self.seconds[test]
        return [stage for stage in (first, within) if stage]

    def try_out(self, mutant: Mutant) -> dict[str, Any] | None:
        """What became of a mutant; None if its time did not come."""
        if time.monotonic() > self.ends:
            return None
        begins = time.perf_counter()
        tests = self.tests_of(mutant)
        stages = self.order(tests)
        tree = self.trees.get()
        file = tree / mutant.file
        source = file.read_bytes()
        file.write_bytes(mutant.of(source))
        failed = None
        try:
            for stage in stages:
                limit_s = self.grace_s + 3 * sum(self.seconds[test] for test in stage)
                failed = failed or _processed(self.root, tree, {"wanted": stage}, limit_s)["failed"]
        finally:
            file.write_bytes(source)
            self.trees.put(tree)
        return {
            "mutant": mutant.label,
            "line": mutant.place.lines.start,
            "by": failed,
            "seconds": round(time.perf_counter() - begins, 1),
            "tests": sum(len(stage) for stage in stages),
            "left_out": len(tests) - sum(len(stage) for stage in stages),
        }


def reviewed(file: Path) -> dict[str, str]:
    """Mutant -> why no test can notice it."""
    if not file.exists():
        return {}
    entries = [line for line in file.read_text("utf-8").splitlines() if line and line[0] != "#"]
    return dict(line.rsplit("  # ", 1) for line in entries)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", "--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="all results as JSON")
    parser.add_argument("--again", action="store_true", help="try those that survived again")
    parser.add_argument("--match", default="", help="only mutants whose label has this text")
    parser.add_argument("--minutes", type=float, default=1e6, help="begin nothing after that")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--grace-s", type=float, default=20, help="beyond three times the tests'")
    parser.add_argument("--budget-s", type=float, default=40, help="of tests after the first")
    parser.add_argument("--root", type=Path, default=ROOT)
    parser.add_argument("--of", nargs="+", default=MUTATED, help="folders that are mutated")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="folders or files")
    parser.add_argument("--equivalent", type=Path, default=EQUIVALENT)
    args = parser.parse_args()
    FORK.set_forkserver_preload(LIBRARIES)
    ends = time.monotonic() + 60 * args.minutes
    root = args.root.resolve()
    run = Run(root, args.of, args.tests, args.jobs, args.grace_s, args.budget_s, ends)
    run.kept.mkdir(parents=True, exist_ok=True)
    drawn = [
        each for each in draw(root, args.of, args.seed, args.number) if args.match in each.label
    ]
    results = run.kept / "results.jsonl"
    lines = results.read_text("utf-8").splitlines() if results.exists() else []
    known = {each["mutant"]: each for each in map(json.loads, lines)}
    to_do = [each for each in drawn if each.label not in known]
    if args.again:
        to_do = [each for each in drawn if not known.get(each.label, {}).get("by")]
    with run.copies(), results.open("a", encoding="utf-8") as file:
        if to_do and run.measure():
            with ThreadPoolExecutor(args.jobs) as pool:
                for result in pool.map(run.try_out, to_do):
                    if result:
                        known[result["mutant"]] = result
                        file.write(json.dumps(result) + "\n")
                        file.flush()
    return report([known[each.label] for each in drawn if each.label in known], len(drawn), args)


def report(results: list[dict[str, Any]], number: int, args: argparse.Namespace) -> int:
    equivalent = reviewed(args.equivalent)
    survived = [each for each in results if not each["by"]]
    missed = [each for each in survived if each["mutant"] not in equivalent]
    if args.json:
        print(json.dumps(results, indent=1))
        return bool(missed)
    for each in results:
        if each["by"]:
            print(f"caught    {each['seconds']:5.1f} s  {each['mutant']}  by {each['by']}")
    for each in survived:
        why = equivalent.get(each["mutant"])
        told = (
            f"equivalent: {why}" if why else f"{each['tests']} tests, {each['left_out']} left out"
        )
        print(f"survived  {each['seconds']:5.1f} s  line {each['line']}, {each['mutant']}  {told}")
    mean_s = sum(each["seconds"] for each in results) / max(len(results), 1)
    print(
        f"{number} drawn, {len(results)} tried, {len(results) - len(survived)} caught, "
        f"{len(survived) - len(missed)} equivalent, {len(missed)} missed; {mean_s:.1f} s each"
    )
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
