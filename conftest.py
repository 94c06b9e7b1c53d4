"""What all tests share."""

from __future__ import annotations

import gc
import os
import re
import sys
import tomllib
from collections.abc import Generator, Iterator, Mapping
from contextlib import ExitStack
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from chain import CHAIN_PATIENCE_S, Chain, running_chain
from hypothesis import settings
from yaml_once import remember_yaml

# Machines that run tests are slow now and then: time per example says nothing about the code. The
# same examples every time, so that a failure is that of the change; new ones are searched for by
# `make slow`.
settings.register_profile("default", deadline=None, derandomize=True)
settings.register_profile("searching", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

IN_REAL_TIME = {"wire", "fault", "netns", "ros2"}
"""Folders of tests that begin processes and wait for them: one file at a time on two cores."""
WHOLE_ROBOTS = {"wire", "fault"}
"""Of these, those with files of whole robots: one runs at a time, one of each with four cores.
Their files hand a robot on to each other, and those that kill its nodes are the last to have it."""
KILLS = "fault"
LEFT_OUT = {**dict.fromkeys(IN_REAL_TIME, "realtime"), "franka": "franka", "models": "models"}
"""Folder -> mark of everything in it."""

MARKS_OF_A_FILE = re.compile(r"^pytestmark = (\[[^\]]*|.*)", re.M)
ROOT = Path(__file__).parent
NICENESS = os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0
"""Of this process when it began, see Makefile."""
RUBBISH = 10_000
"""Objects between two searches for rubbish: with Python's 700 they take 3 of 100 seconds."""


os.environ.setdefault("VLA_ZENOH_RENDERER", "raycast")
"""Small images cost the same in both ways; whether OpenGL works takes a second to find out."""


def pytest_configure() -> None:
    """End at once where this environment lacks a plug-in of this checkout: nothing would load."""
    there = entry_points()
    for file in [ROOT / "pyproject.toml", *(ROOT / "plugins").glob("*/pyproject.toml")]:
        project = tomllib.loads(file.read_text("utf-8"))["project"]
        for group, wanted in project.get("entry-points", {}).items():
            if lacking := sorted(wanted.keys() - there.select(group=group).names):
                names = ", ".join(lacking)
                raise pytest.UsageError(f"{group} lacks {names} of {file}: run `make setup`")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not even import what -m leaves out: that takes as long as many tests."""
    chosen = config.option.markexpr
    if collection_path.suffix == ".py":
        text = collection_path.read_text("utf-8")
        said = " ".join(MARKS_OF_A_FILE.findall(text))
        if any(f"not {mark} " in f"{chosen} " for mark in re.findall(r"mark\.(\w+)", said)):
            return True
        folders = IN_REAL_TIME.intersection(collection_path.relative_to(ROOT).parts)
        if chosen.endswith("and realtime") and not folders and "realtime" not in text:
            return True
    mark = LEFT_OUT.get(collection_path.name)
    within = collection_path.parent.name in ("tests", "reliability")
    return True if within and mark and f"not {mark}" in chosen else None


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """By file, but all those of whole robots to one worker: the others run beside them."""
    if config.option.dist != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            folder = file.split("/")[1]
            if folder not in WHOLE_ROBOTS:
                return file
            return folder if (os.cpu_count() or 1) >= 4 else "all folders"

    return ByFile(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported stays; to look through it for rubbish takes a quarter of the time."""
    remember_yaml()
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(RUBBISH, 20, 20)
        gc.enable()


def pytest_collection_finish() -> None:
    if "vla_zenoh.kinematics.collision" in sys.modules:
        from collision_once import remember_distances

        remember_distances()


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    robots_s: dict[Path, tuple[float, bool]] = {}
    for item in items:
        if item.path.relative_to(ROOT).parts[1] in IN_REAL_TIME:
            item.add_marker(pytest.mark.realtime)
        if _is_lent_a_robot(item):
            kills = item.path.parent.name == KILLS
            robots_s[item.path] = _patience_s(item)["command"], kills
    # Files that can go on with the same robot follow each other; those of whole robots are the
    # longest row, so they begin at once.
    items.sort(
        key=lambda item: (
            item.path.parent.name not in WHOLE_ROBOTS,
            robots_s.get(item.path, (0.0, False)),
        )
    )


@pytest.hookimpl(tryfirst=True)  # before the fixtures are made
def pytest_runtest_setup(item: pytest.Function) -> None:
    """A test that is tried again begins with new processes, whatever the failed try left behind."""
    if getattr(item, "execution_count", 1) == 1:
        return
    request: Any = item._request
    for fixtures in item._fixtureinfo.name2fixturedefs.values():
        for fixture in fixtures:
            if fixture.scope == "module":
                fixture.finish(request)
    ROBOT.close()


@pytest.hookimpl(trylast=True)  # after the fixtures of a file have ended
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    if nextitem is None or not (nextitem.path == item.path or _is_lent_a_robot(nextitem)):
        ROBOT.close()
    # A command such as ``stop`` that ran in this process runs before other programs, so all tests
    # after it would, too: those in real time would wait for those that compute.
    if hasattr(os, "setpriority") and os.getpriority(os.PRIO_PROCESS, 0) != NICENESS:
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def pytest_sessionfinish() -> None:
    ROBOT.close()


class KeptRobot:
    """A robot that goes from file to file: five processes take ten seconds to be ready."""

    def __init__(self) -> None:
        self._patience_s: Mapping[str, float] = {}
        self._running = ExitStack()
        self._chain: Chain | None = None

    def get(self, folder: Path, patience_s: Mapping[str, float]) -> Chain:
        """The one that runs, if it is as patient; else a new one."""
        if self._chain is None or patience_s != self._patience_s:
            self.close()
            chain = self._running.enter_context(running_chain(folder, patience_s=patience_s))
            chain.activate_when_ready()
            self._chain, self._patience_s = chain, patience_s
        return self._chain

    def close(self) -> None:
        self._chain = None
        self._running.close()


ROBOT = KeptRobot()


def _is_lent_a_robot(item: pytest.Item) -> bool:
    """Whether it takes the robot of this file, and its folder hands that on."""
    fixtures: Any = getattr(item, "_fixtureinfo", None)
    chains = fixtures.name2fixturedefs.get("shared_chain", ()) if fixtures else ()
    return len(chains) == 1 and item.path.parent.name in WHOLE_ROBOTS


def _patience_s(of: Any) -> Mapping[str, float]:
    return getattr(of.module, "ROBOT_PATIENCE_S", CHAIN_PATIENCE_S)


@pytest.fixture(scope="module")
def shared_chain(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Chain]:
    """One robot for all tests of a file; take `chain` instead, which begins in order."""
    failed = request.session.testsfailed
    yield ROBOT.get(tmp_path_factory.mktemp("chain"), _patience_s(request))
    if request.path.parent.name not in WHOLE_ROBOTS or request.session.testsfailed > failed:
        ROBOT.close()


@pytest.fixture
def chain(shared_chain: Chain) -> Chain:
    """The file's robot: inactive, standing, nothing recorded, no event unread."""
    shared_chain.settle()
    shared_chain.recorder.forget()
    shared_chain.client.pop_events()
    for child in shared_chain.host.supervisor.children:
        child.deaths_in_a_row = 0  # by the tests before: it would wait longer each time
    assert not shared_chain.failure, shared_chain.failure
    return shared_chain
