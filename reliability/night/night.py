"""A night of unattended trial under `kill -9` and a power cut, on a simulated arm in real time.

    python reliability/night/night.py --episodes 50 --output runs/night

`vla-zenoh up` and `vla-zenoh nights` run as processes. Their nodes and the trial
itself are killed at random, and once everything is at the same time. Of two tasks one is always
done and the other never, by a Python judge that measures how far the arm rose; so the right table
is known. Prints what was found as JSON; exit code 1: something is not as it has to be.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import contextlib

from chain import write_profile
from vla_zenoh_nights.trial import UnattendedTrial
from vla_zenoh_trial.folder import TrialFolder

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.verdict import verdict_in

MODELS = """\
workers: [scripted, twin]
models: {twin: scripted}
"""
WORKERS = ("scripted", "twin")
RISE_M = 0.02
TASKS = {"rises": ("HARD: go up x3", True), "stays_low": ("HARD: go up x1", False)}
JUDGE = f"""\
def judge(episode):
    rise_m = float(episode.states[-1].pose.position_m[2] - episode.states[0].pose.position_m[2])
    assert episode.picture("front").ndim == 3
    return rise_m > {RISE_M}, f"rose {{rise_m * 1e3:.0f}} mm"
"""
KILL_S = (8.0, 20.0)
POLL_S = 0.5
NODES = ("router", "sim", "camera", "command", "worker")


@dataclass
class Night:
    """The processes of a night.

    Args:
        folder: for plan, profile, log and result.
        episodes: of each task and worker.
        random: of the faults.
        kill_s: shortest and longest time between two of them.
    """

    folder: Path
    episodes: int
    random: random.Random
    kill_s: tuple[float, float] = KILL_S
    killed: Counter[str] = field(default_factory=Counter)
    up: subprocess.Popen[bytes] | None = None
    trial: subprocess.Popen[bytes] | None = None

    @property
    def output(self) -> Path:
        """Folder of the trial."""
        return self.folder / "trial"

    def prepare(self) -> None:
        """Write profile, plan and judge."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.profile = write_profile(self.folder, more=MODELS)
        (self.folder / "judge.py").write_text(JUDGE)
        plan = {
            "workers": WORKERS,
            "tasks": [
                {"name": name, "prompt": prompt, "episodes": self.episodes, "seconds": 15}
                for name, (prompt, _) in TASKS.items()
            ],
            "reset": {"simulator": True},
            "judge": {"file": "judge.py"},
            "stop": {"voids_in_a_row": 100},
            "seed": 1,
        }
        (self.folder / "plan.yaml").write_text(json.dumps(plan))

    def run(self, limit_s: float) -> int:
        """Run it to its end under faults; exit code of the trial.

        Raises:
            TimeoutError: it did not end.
        """
        end_s, cut = time.monotonic() + limit_s, False
        self._start_up()
        self._start_trial()
        due_s = time.monotonic() + 2 * self.kill_s[1]  # the start itself takes a while
        try:
            while True:
                assert self.up is not None
                assert self.trial is not None
                code = self.trial.poll()
                if code == -signal.SIGKILL:
                    self._start_trial()
                elif code is not None:
                    return code
                if self.up.poll() is not None:
                    self._start_up()
                if time.monotonic() > end_s:
                    raise TimeoutError(f"not over after {limit_s:.0f} s")
                judged = sum(len(judged_of(folder)) for folder in self._folders())
                if not cut and judged * 2 >= self.episodes * len(TASKS) * len(WORKERS):
                    cut = True
                    self._cut_power()
                    due_s = time.monotonic() + 2 * self.kill_s[1]
                elif time.monotonic() > due_s:
                    self._kill_one()
                    due_s = time.monotonic() + self.random.uniform(*self.kill_s)
                time.sleep(POLL_S)
        finally:
            self._end()

    def _folders(self) -> list[TrialFolder]:
        return [TrialFolder(self.output / name) for name in TASKS]

    def _start(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "vla_zenoh", *words],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "VLA_ZENOH_PROFILE": str(self.profile), "NO_COLOR": "1"},
                start_new_session=True,
            )

    def _start_up(self) -> None:
        self.up = self._start("up", "up", "--log-dir", str(self.folder))

    def _start_trial(self) -> None:
        plan = str(self.folder / "plan.yaml")
        words = ("nights", plan, "--output", str(self.output), "--json")
        self.trial = self._start("trial", *words)

    def _kill_one(self) -> None:
        assert self.up is not None
        assert self.trial is not None
        names = {name: pid for pid, name in self._nodes()} | {"trial": self.trial.pid}
        # Each once before any of them twice.
        fewest = min(self.killed[name] for name in names)
        name = self.random.choice([each for each in sorted(names) if self.killed[each] == fewest])
        self._kill(names[name])
        self.killed[name] += 1

    def _cut_power(self) -> None:
        assert self.up is not None
        assert self.trial is not None
        for pid in [self.up.pid, self.trial.pid, *(pid for pid, _ in self._nodes())]:
            self._kill(pid)
        self.killed["power"] += 1
        self.up.wait()
        self.trial.wait()
        self._start_up()
        self._start_trial()

    def _nodes(self) -> list[tuple[int, str]]:
        """Processes below `up`, with the names of their nodes."""
        assert self.up is not None
        found: list[tuple[int, str]] = []
        parents = {self.up.pid}
        while parents:
            children = {pid for parent in parents for pid in _children(parent)}
            found += [(pid, _name(pid)) for pid in children]
            parents = children
        return found

    @staticmethod
    def _kill(pid: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    def _end(self) -> None:
        for process in (self.trial, self.up):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGINT)
                try:
                    process.wait(20.0)
                except subprocess.TimeoutExpired:
                    for pid, _ in self._nodes():
                        self._kill(pid)
                    process.kill()
                    process.wait()


def _children(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    except OSError:
        return "gone"
    kind = next((each for each in NODES if each in words), "other")
    worker = next((each for each in WORKERS if each in words), "")
    return f"{kind} {worker}".strip() if kind == "worker" else kind


def judged_of(folder: TrialFolder) -> list[tuple[int, str, str]]:
    """(setup, worker, verdict) of the episodes that count."""
    return [
        (each.setup, each.worker, each.verdict)
        for each in folder.episodes()
        if each.verdict != "void"
    ]


def examine(night: Night, code: int) -> tuple[dict[str, Any], list[str]]:
    """What a night gave, and what of it is wrong."""
    wrong = [] if code == 0 else [f"exit code {code}"]
    trial = UnattendedTrial(night.output, None, "")
    void = unlabelled = 0
    for name, (_, rises) in TASKS.items():
        folder = TrialFolder(night.output / name)
        judged = judged_of(folder)
        every = {(setup, worker) for setup in range(1, night.episodes + 1) for worker in WORKERS}
        if sorted(each[:2] for each in judged) != sorted(every):
            wrong.append(f"{name}: {len(judged)} verdicts of {len(every)}, or one of them twice")
        expected = "success" if rises else "failure"
        wrong += [f"{name}: {each} is not {expected}" for each in judged if each[2] != expected]
        numbers = [each.number for each in folder.episodes()]
        if len(set(numbers)) < len(numbers):
            wrong.append(f"{name}: two attempts have one number")
        for each in folder.episodes():
            void += each.verdict == "void"
            if each.verdict != "void":
                recording = open_recording(folder.path / each.recording)
                for _ in recording.entries(lambda _: False):
                    pass
                unlabelled += verdict_in(recording.ended, each.worker) != each.verdict
    page = (night.output / "index.html").read_text()
    total = night.episodes * len(TASKS) * len(WORKERS)
    if f"{total} of {total} episodes" not in page:
        wrong.append("the page does not have every episode")
    if page.count("<img") != total:
        wrong.append(f"the page has {page.count('<img')} film strips of {total}")
    kinds = Counter(line["what"] for line in trial.journal())
    result = {
        "episodes": total,
        "void": void,
        "labels_missing_in_recordings": unlabelled,
        "killed": dict(night.killed),
        "journal": dict(kinds),
        "rates": {
            task.name: {each.worker: each.rate for each in found.workers}
            for task, found, _ in trial.scores()
        },
    }
    return result, wrong


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=50, help="of each of 2 tasks, 2 workers")
    parser.add_argument("--output", type=Path, default=Path("runs/night"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0)
    given = parser.parse_args()
    night = Night(given.output, given.episodes, random.Random(given.seed))
    night.prepare()
    began_s = time.monotonic()
    result, wrong = examine(night, night.run(given.minutes * 60))
    result |= {"seconds": round(time.monotonic() - began_s), "wrong": wrong}
    print(json.dumps(result, indent=2))
    return bool(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
