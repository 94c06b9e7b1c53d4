"""The benchmark contract: what the file of a benchmark has to have.

A benchmark is a class with `action`, `cameras`, ``tasks``, ``reset``, ``observe`` and ``step``, in
a file with a PEP 723 header that names its packages. It runs in an environment of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError, WorkerError, in_words
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.loader import ModelFile, find_maker
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState, PrivilegedState

Picture = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class BenchmarkTask:
    """A task of a suite.

    Args:
        name: of the task, in the benchmark's own words.
        prompt: its language.
        max_steps: steps after which an episode has failed.
        episodes: number of its initial states; 0: an episode's index is a seed, any will do.
    """

    name: str
    prompt: str
    max_steps: int
    episodes: int = 0


class BenchmarkObservation(NamedTuple):
    """What the environment shows now.

    Args:
        images: camera -> (H, W, 3) RGB, turned as the published protocol turns it.
        joint: None where the environment does not tell.
        pose: of the TCP, in the frame that the environment's own observation uses.
        gripper: its opening.
        privileged: what its own expert reads.
    """

    images: Mapping[str, Picture] = {}
    joint: JointState | None = None
    pose: PoseState | None = None
    gripper: GripperState | None = None
    privileged: PrivilegedState | None = None


@runtime_checkable
class Benchmark(Protocol):
    """Suites of tasks in an environment that moves by steps.

    Optional: ``hold() -> NDArray``, the step that stands still, required where `action` is
    absolute; ``physics() -> NDArray``, the whole state of the simulation, whose hash tells whether
    two episodes ended alike; ``close()``; ``set_point(position_m, width_m) -> NDArray``, the raw
    action towards a commanded TCP position, which puts our command node into the path.

    Attributes:
        action: what the numbers of a step mean; `horizon` says nothing here.
        cameras: camera -> (width, height).
        suites: names, the first one is the default.
        packages: whose versions a result has to tell.
    """

    action: ActionSpec
    cameras: Mapping[str, tuple[int, int]]
    suites: Sequence[str]
    packages: Sequence[str]

    def tasks(self, suite: str) -> Sequence[BenchmarkTask]:
        """The tasks of a suite, in the benchmark's own order."""
        ...

    def reset(self, suite: str, task: str, episode: int) -> None:
        """Begin an episode at its initial state, by the protocol of the benchmark."""
        ...

    def observe(self, cameras: Sequence[str]) -> BenchmarkObservation:
        """What there is to see now; only `cameras` are drawn."""
        ...

    def step(self, action: FloatArray) -> bool:
        """Carry out one step, (D,) as `action` declares; whether the task is done."""
        ...


def make_benchmark(file: ModelFile, options: Mapping[str, str] | None = None) -> Benchmark:
    """Construct the benchmark of a file: its only class with ``observe``, or ``BENCHMARK``.

    Raises:
        WorkerError: the file fails to import, has no such class, or rejects the options.
    """
    found = find_maker(file, "BENCHMARK", "observe").make(options or {})
    try:
        fits = isinstance(found, Benchmark)
    except Exception as error:  # a property that fails
        raise WorkerError(f"{file.path}: {in_words(error)}") from error
    if not fits:
        wanted = "action, cameras, suites, packages, tasks, reset, observe, step"
        missing = [name for name in wanted.split(", ") if not hasattr(found, name)]
        raise WorkerError(f"{file.path}: the benchmark lacks {', '.join(missing)}")
    return found


SAME = ("kind", "space", "joints", "frame", "relative_to", "rotation", "gripper")
"""What a model and a benchmark have to agree on; both may have another unit of x, y, z, and another
sign of a gripper that is open or shut."""


def raw_steps(steps: NDArray[np.float32], spec: ActionSpec, wanted: ActionSpec) -> FloatArray:
    """Steps of a model in the units of the benchmark's `ActionSpec`.

    Raises:
        SpecError: they do not mean the same; names what differs.
    """
    wrong = [
        f"{name} is {getattr(spec, name)!r}, the benchmark's {getattr(wanted, name)!r}"
        for name in SAME
        if getattr(spec, name) != getattr(wanted, name)
    ]
    if abs(spec.dt_s / wanted.dt_s - 1) > 0.01:
        wrong.append(f"dt_s is {spec.dt_s:g}, the benchmark's {wanted.dt_s:g}")
    if wrong:
        raise SpecError(f"the model's actions are not the benchmark's: {'; '.join(wrong)}")
    out = np.asarray(steps, np.float64).copy()
    if spec.space == "tcp" and spec.position_scale_m != wanted.position_scale_m:
        out[:, :3] *= spec.position_scale_m / wanted.position_scale_m
    if wanted.gripper == "binary":
        mine = (spec.gripper_open_is_high, spec.gripper_threshold)
        if mine != (wanted.gripper_open_is_high, wanted.gripper_threshold):
            opens = np.array([spec.opens(number) for number in out[:, -1]])
            high = opens == wanted.gripper_open_is_high
            out[:, -1] = wanted.gripper_threshold + np.where(high, 1.0, -1.0)
    return out


def standing_step(benchmark: Benchmark, last: FloatArray | None) -> FloatArray:
    """The step that keeps the arm where it is, and the gripper as `last` left it."""
    hold = getattr(benchmark, "hold", None)
    out = np.zeros(benchmark.action.dimension) if hold is None else np.array(hold(), np.float64)
    if last is not None:
        if benchmark.action.targets:
            return last.copy()
        if benchmark.action.gripper != "none" and benchmark.action.gripper != "delta_m":
            out[-1] = last[-1]
    return out
