"""Runs a benchmark in an environment of its own: a child process, and the parent's end of it.

Requests and outcomes are lines of JSON on the child's stdin and stdout; what libraries print there
goes to stderr. Only that child imports the benchmark's packages.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import Thread
from typing import Any, TextIO

import numpy as np

from vla_zenoh.bus.session import open_session
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.errors import NodeError, VlaZenohError, WorkerError, in_words
from vla_zenoh.plugins import how_to_repeat
from vla_zenoh.policy import ModelSpec
from vla_zenoh.policy.loader import ModelFile, find_model
from vla_zenoh.profile import as_robot, load_profile
from vla_zenoh.resources import BENCHMARKS
from vla_zenoh.runtime.environments import environment_command
from vla_zenoh.runtime.process import PARENT_VARIABLE, die_with_parent
from vla_zenoh.types import FloatArray, Image
from vla_zenoh_benchmarks.asked_worker import AskedWorker
from vla_zenoh_benchmarks.contract import Benchmark, BenchmarkTask, make_benchmark, raw_steps
from vla_zenoh_benchmarks.episode import (
    Asked,
    EpisodeClock,
    EpisodeConditions,
    EpisodeOutcome,
    EpisodeRequest,
    Recorder,
    state_hash,
)
from vla_zenoh_benchmarks.takeover import Takeover

EXTRAS = {"control": "ruckig", "record": "mcap"}
"""Extra of this package -> one of its packages."""
ANSWER_PATIENCE_S = 300.0
FRAME_HZ = 10
LAST_LINES = 20


def teachers_robot(robot: str) -> str:
    """In whose keys a teacher is asked: two writers of one robot's state would be one too many."""
    return f"{robot}_teacher"


class BenchmarkLost(NodeError):
    """The child process ended in the middle of a request."""


@dataclass(frozen=True, slots=True)
class BenchmarkSetting:
    """What a child needs to run episodes.

    Args:
        profile_file: of the robot, with the address of the router.
        record: cameras to record every episode with; none: nothing is recorded.
        recordings: folder of the recordings.
    """

    benchmark: str
    options: Mapping[str, str] = field(default_factory=dict)
    profile_file: str = ""
    worker: str = ""
    conditions: EpisodeConditions = field(default_factory=EpisodeConditions)
    record: tuple[str, ...] = ()
    recordings: str = ""

    @property
    def file(self) -> ModelFile:
        """The benchmark's file. Raises ResourceError: there is none."""
        return find_model(self.benchmark, BENCHMARKS)


class BenchmarkProcess:
    """A benchmark in a process of its own.

    Args:
        robot: in whose keys it runs.
        python: interpreter of a prepared environment; None: the file's header is obeyed.

    Raises:
        WorkerError: its environment cannot be made.
    """

    def __init__(self, setting: BenchmarkSetting, robot: str, python: str | None = None) -> None:
        file = setting.file
        needs = {"control": setting.conditions.mode == "command", "record": bool(setting.record)}
        extra = ",".join(name for name, needed in needs.items() if needed)
        lacks = file.missing() or any(
            needs[name] and not _has(package) for name, package in EXTRAS.items()
        )
        command = [sys.executable]
        if python is not None:
            command = [python]
        elif lacks:
            ours = how_to_repeat("vla-zenoh-benchmarks")
            command = [*environment_command(file, extra=extra), *ours, "python"]
        given = json.dumps({**asdict(setting), "benchmark": str(file.path), "robot": robot})
        self._process = subprocess.Popen(
            [*command, "-m", "vla_zenoh_benchmarks.process", given],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, PARENT_VARIABLE: str(os.getpid())},
        )
        self.last_lines: deque[str] = deque(maxlen=LAST_LINES)
        assert self._process.stderr is not None
        Thread(target=self._log, args=(self._process.stderr,), daemon=True).start()

    @property
    def pid(self) -> int:
        """Of the child; where uv stands between, that of uv."""
        return self._process.pid

    def describe(self, suite: str | None = None) -> dict[str, Any]:
        """Suites, tasks of one of them, cameras, action, and versions of packages.

        Raises:
            NodeError: there is no such suite.
        """
        return self._call({"do": "describe", "suite": suite})

    def run(self, request: EpisodeRequest) -> EpisodeOutcome:
        """Run an episode.

        Raises:
            BenchmarkLost: the child ended.
            NodeError: the benchmark or the worker failed.
        """
        return _outcome(self._call({"do": "run", **asdict(request)}))

    def replay(
        self, request: EpisodeRequest, actions: np.ndarray, camera: str, folder: Path
    ) -> EpisodeOutcome:
        """Carry out recorded steps, and draw the pictures of a video into `folder`.

        Args:
            actions: (n, D), every step.
            camera: empty: nothing is drawn.

        Raises:
            BenchmarkLost: the child ended.
            NodeError: the benchmark failed.
        """
        file = folder / "actions.npy"
        np.save(file, actions)
        given = {"do": "replay", **asdict(request), "actions": str(file)}
        return _outcome(self._call({**given, "camera": camera, "folder": str(folder)}))

    def close(self) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
            self._process.wait(10)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()

    def _call(self, request: Mapping[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except OSError:
            line = ""
        if not line:
            self._process.wait()
            said = "\n".join(self.last_lines)
            raise BenchmarkLost(f"the benchmark's process ended: {said or 'it said nothing'}")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise NodeError(answer["error"])
        return answer

    def _log(self, stream: TextIO) -> None:
        for line in stream:
            self.last_lines.append(line.rstrip())


def _outcome(answer: Mapping[str, Any]) -> EpisodeOutcome:
    actions = [np.asarray(each, np.float64) for each in answer["actions"]]
    return EpisodeOutcome(**{**answer, "actions": actions})


def _has(package: str) -> bool:
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True


def run_episode(
    benchmark: Benchmark,
    request: EpisodeRequest,
    worker: Asked,
    conditions: EpisodeConditions,
    recorder: Recorder | None = None,
    takeover: Takeover | None = None,
) -> EpisodeOutcome:
    """Run an episode; the model is asked by `worker`.

    Args:
        recorder: who keeps every step; None: nobody.
        takeover: who leads from where it disagrees; None: nobody.

    Raises:
        NodeError: the worker does not answer.
        SpecError: its actions are not the benchmark's.
    """
    began_s = time.perf_counter()
    benchmark.reset(request.suite, request.task.name, request.episode)
    worker.begin(request.task.prompt)
    clock = EpisodeClock(benchmark, request, worker, recorder)
    if recorder is not None:
        recorder.begin(request.task.prompt)
    if takeover is not None:
        takeover.begin(clock)
    if conditions.mode == "command":
        from vla_zenoh_benchmarks.command_path import run_through_command_node

        run_through_command_node(clock, conditions)
        return clock.finish(began_s)
    while not clock.over:
        steps = raw_steps(clock.ask(), clock.spec.action, benchmark.action)
        # Before its first chunk the arm is not active yet, and the clock stands.
        if conditions.mode == "live" and clock.outcome.steps:
            given_s = None if conditions.delay_ms is None else conditions.delay_ms / 1e3
            delay_s = clock.asked_s if given_s is None else given_s
            clock.stand(math.ceil(round(delay_s / benchmark.action.dt_s, 6)))
        for action in steps[: conditions.replan or None]:
            if takeover is not None and not clock.over and takeover.disagrees(clock, action):
                takeover.lead(clock)
            clock.step(action)
    return clock.finish(began_s)


def replay_episode(
    benchmark: Benchmark,
    request: EpisodeRequest,
    actions: Sequence[FloatArray],
    look: Callable[[int], None] = lambda step: None,
) -> EpisodeOutcome:
    """Execute recorded steps from the same initial state, without a model.

    Args:
        look: called with the number of steps so far, 0 first.
    """
    began_s = time.perf_counter()
    benchmark.reset(request.suite, request.task.name, request.episode)
    out = EpisodeOutcome(request.suite, request.task.name, request.episode)
    look(0)
    for action in actions:
        out.success = bool(benchmark.step(action))
        out.steps += 1
        look(out.steps)
    out.wall_s, out.end = time.perf_counter() - began_s, state_hash(benchmark)
    out.failure = "" if out.success else "steps"
    return out


class _Child:
    def __init__(self, given: dict[str, Any]) -> None:
        self._robot = given.pop("robot")
        conditions = EpisodeConditions(**given.pop("conditions"))
        self._setting = BenchmarkSetting(conditions=conditions, **given)
        self.benchmark: Benchmark = make_benchmark(self._setting.file, self._setting.options)
        self._worker: AskedWorker | None = None
        self._takeover: Takeover | None = None

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        do = request.pop("do")
        if do == "describe":
            return self._describe(request["suite"])
        folder, camera = request.pop("folder", ""), request.pop("camera", "")
        file = request.pop("actions", "")
        wanted = EpisodeRequest(**{**request, "task": BenchmarkTask(**request["task"])})
        if do == "run":
            found = self._run(wanted)
        else:
            every = max(1, round(1 / FRAME_HZ / self.benchmark.action.dt_s))
            steps = np.load(file)

            def look(step: int) -> None:
                if camera and (step % every == 0 or step == len(steps)):
                    picture = self.benchmark.observe([camera]).images[camera]
                    jpeg = encode_jpeg(Image(np.ascontiguousarray(picture)))
                    (Path(folder) / f"{step:06d}.jpg").write_bytes(jpeg)

            found = replay_episode(self.benchmark, wanted, list(steps), look)
        actions = [each.tolist() for each in found.actions]
        return {**found.to_dict(), "actions": actions}

    def _run(self, wanted: EpisodeRequest) -> EpisodeOutcome:
        worker, takeover, setting = self._asked(), self._takeover, self._setting
        conditions = setting.conditions
        if not setting.record:
            return run_episode(self.benchmark, wanted, worker, conditions, None, takeover)
        from vla_zenoh_benchmarks.recorded import EpisodeRecorder, recording_file

        recorder = EpisodeRecorder(
            recording_file(Path(setting.recordings), wanted.key),
            self._profile,
            setting.worker,
            worker.spec,
            setting.record,
            self.benchmark.action,
        )
        try:
            found = run_episode(self.benchmark, wanted, worker, conditions, recorder, takeover)
            recorder.finish(success=found.success, steps=found.steps)
        except BaseException:
            recorder.abandon()
            raise
        return found

    def _asked(self) -> AskedWorker:
        if self._worker is None:
            profile = as_robot(load_profile(self._setting.profile_file), self._robot)
            self._profile = profile
            session = open_session(profile.session, wait_s=10.0)
            name, conditions = self._setting.worker, self._setting.conditions
            self._worker = AskedWorker(profile, session, name, ANSWER_PATIENCE_S)
            self._require_seen(self._worker.spec)
            if conditions.takeover:
                beside = as_robot(profile, teachers_robot(self._robot))
                teacher = AskedWorker(beside, session, conditions.takeover, ANSWER_PATIENCE_S)
                self._require_seen(teacher.spec)
                self._takeover = Takeover(teacher, conditions.disagreement)
        return self._worker

    def _require_seen(self, spec: ModelSpec) -> None:
        """Raises WorkerError: a model needs what the benchmark does not show."""
        known, looks = self.benchmark.cameras, spec.observation
        if missing := [one.camera for one in looks.cameras if one.camera not in known]:
            raise WorkerError(
                f"model {spec.name!r} needs the cameras {', '.join(missing)}; "
                f"the benchmark has: {', '.join(known)}"
            )
        if looks.depth or looks.history > 1:
            raise WorkerError(
                f"model {spec.name!r} needs {'depth' if looks.depth else 'a history'}, which no "
                "benchmark gives"
            )

    def _describe(self, suite: str | None) -> dict[str, Any]:
        found = self.benchmark
        suite = suite or found.suites[0]
        if suite not in found.suites:
            raise WorkerError(f"there is no suite {suite!r}; known: {', '.join(found.suites)}")
        versions = {name: version(name) for name in found.packages if _has(name)}
        return {
            "suites": list(found.suites),
            "suite": suite,
            "tasks": [asdict(task) for task in found.tasks(suite)],
            "cameras": {name: list(size) for name, size in found.cameras.items()},
            "dt_s": found.action.dt_s,
            "max_width_m": getattr(found, "max_width_m", None),
            "action": found.action.model_dump(mode="json"),
            "versions": {**versions, "python": sys.version.split()[0]},
        }


def main() -> None:
    """The child: answers requests until its stdin ends."""
    die_with_parent()
    os.environ.setdefault("MUJOCO_GL", "egl")  # no display
    with os.fdopen(os.dup(1), "w") as out:
        os.dup2(2, 1)  # libraries print what is no answer
        sys.stdout = sys.stderr
        try:
            child: _Child | None = _Child(json.loads(sys.argv[1]))
            broken = ""
        except (Exception, SystemExit) as error:
            child, broken = None, _said(error)
        for line in sys.stdin:
            if child is None:
                answer: dict[str, Any] = {"error": broken}
            else:
                try:
                    answer = child.answer(json.loads(line))
                except Exception as error:
                    answer = {"error": _said(error)}
            print(json.dumps(answer), file=out, flush=True)
    os._exit(0)  # threads of a benchmark's library may keep the process alive


def _said(error: BaseException) -> str:
    return str(error) if isinstance(error, VlaZenohError) else in_words(error)


if __name__ == "__main__":
    main()
