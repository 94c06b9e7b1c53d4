"""A canary on two robots of real processes: watched, refused, promoted in motion, taken back."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from chain import READY_PATIENCE_S, Chain, command_line
from two_robots import two_robots, write_bouncer
from vla_zenoh_canary.record import Promoted, read_record
from vla_zenoh_canary.switch import switch_all

pytestmark = pytest.mark.long

COMMAND_TOLERANCE = 1.1
"""As in tests/fault/test_dead_nodes.py."""
SECONDS, LEAST_PAIRS = 12.0, 20
STEP_MM, ATOL_MM = 10.0, 0.5
BOTH = """\
extends: ./one.yaml
workers: [scripted, canary]
models: {canary: ./canary.py}
serves: {canary: [one, two]}
"""
BOUNCE = "HARD: go up x50000 within 0.1"


class Lab(NamedTuple):
    folder: Path
    one: Chain
    two: Chain

    @property
    def both(self) -> tuple[Chain, Chain]:
        return self.one, self.two

    def canary(self, *words: str, code: int = 0) -> Any:
        """Run ``vla-zenoh canary`` in the folder; its JSON."""
        name, *rest = words
        rest = [str(self.folder / word) if word.endswith(".json") else word for word in rest]
        found = command_line(
            "canary", name, *rest, "--json", profile=self.folder / "both.yaml", timeout_s=120.0
        )
        assert found.returncode == code, f"{found.stdout}\n{found.stderr}"
        return json.loads(found.stdout) if found.stdout else found.stderr

    def watch(self) -> Any:
        return self.canary("watch", "canary", "-o", "f.json", "--force", "-s", str(SECONDS))

    def promote(self, *words: str, code: int = 0) -> Any:
        least = ("--min-seconds", "5", "--min-pairs", str(LEAST_PAIRS))
        return self.canary("promote", "f.json", *least, *words, code=code)

    def back(self) -> Any:
        return self.canary("back", "f.json")

    def obeyed(self) -> list[str]:
        return [chain.client.task.worker for chain in self.both if chain.client.task]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("lab")
    (folder / "both.yaml").write_text(BOTH)
    with two_robots(folder) as (one, two):
        yield Lab(folder, one, two)


@contextmanager
def worker(*words: str) -> Iterator[None]:
    process = subprocess.Popen([sys.executable, "-m", "vla_zenoh", *words])
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


@contextmanager
def shadow(lab: Lab, *, horizon: int = 1) -> Iterator[None]:
    """One process that serves both robots; until they move and it infers for both."""
    write_bouncer(lab.folder / "canary.py", horizon=horizon)
    with worker("worker", "canary", "--profile", str(lab.folder / "both.yaml")):
        for chain in lab.both:
            chain.until(
                "the canary infers",
                lambda chain=chain: chain.state("worker-canary") == "inferring",
                READY_PATIENCE_S,
            )
            chain.client.set_prompt(BOUNCE)
            if chain.state() != "active":
                chain.activate_when_ready()
            chain.until("it moves", chain.moves)
        yield
    for chain in lab.both:
        chain.until("gone", lambda chain=chain: "worker-canary" not in chain.client.alive)


def test_a_canary_is_promoted_on_two_arms_in_motion_and_taken_back_by_one_command(
    lab: Lab,
) -> None:
    with shadow(lab):
        figures = lab.watch()["robots"]
        for robot in ("one", "two"):
            found = figures[robot]
            assert (found["obeyed"], found["new"]["worker"]) == ("scripted", "canary")
            assert found["apart"]["pairs"] >= LEAST_PAIRS
            # One step of 10 mm: in the same direction, or in opposite ones.
            assert 0.0 <= found["apart"]["distance_mm"][1] <= 2 * STEP_MM + ATOL_MM
            assert found["seconds"] == pytest.approx(SECONDS, abs=2.0)
            assert found["new"]["rejected"] == found["new"]["failed"] == {}
            assert found["new"]["age_ms"][0] >= found["new"]["inference_ms"][0] > 0.0
        assert lab.obeyed() == ["scripted", "scripted"]

        refused = lab.canary("promote", "f.json", code=3)["refused"]  # by default 30 s are wanted
        assert {(each["robot"], each["name"]) for each in refused} == {
            ("one", "figures_missing"),
            ("two", "figures_missing"),
        }
        assert lab.obeyed() == ["scripted", "scripted"]

        for chain in lab.both:
            chain.client.pop_events()
        began_ns = time.time_ns()
        for command, name in ((lab.promote, "canary"), (lab.back, "scripted")):
            switched = command()["switched"]
            assert [(each["worker"], each["in_motion"]) for each in switched] == [(name, True)] * 2
            assert lab.obeyed() == [name, name]
            for chain in lab.both:
                assert chain.state() == "active"
                assert not chain.events("active->inactive")
                chain.until("it moves on", chain.moves)
        for chain in lab.both:
            limit = chain.profile.limits.translation.acceleration_m_s2
            assert chain.recorder.hardest_command(began_ns) <= limit * COMMAND_TOLERANCE
        assert read_record(lab.folder / "f.json").promoted == {}
        assert "not_promoted" in lab.canary("back", "f.json", code=1)


def test_an_absent_restarted_or_other_shadow_is_refused_by_name(lab: Lab) -> None:
    def reasons() -> set[str]:
        return {each["name"] for each in lab.promote(code=3)["refused"]}

    with shadow(lab):
        lab.watch()
    assert reasons() == {"shadow_absent"}
    with shadow(lab):
        assert reasons() == {"restarted"}
    with shadow(lab, horizon=2):
        assert reasons() == {"spec_differs"}
    assert lab.obeyed() == ["scripted", "scripted"]


def test_where_one_arm_rejects_it_the_others_obey_their_worker_again(lab: Lab) -> None:
    with shadow(lab):
        lab.watch()
        record = replace(read_record(lab.folder / "f.json"), new="solo")
        words = ["worker", str(lab.folder / "canary.py"), "--name", "solo"]
        with worker(*words, "--profile", str(lab.folder / "one.yaml")):
            lab.one.until("solo infers", lambda: lab.one.state("worker-solo") == "inferring")
            time.sleep(1.0)  # until its command node has had a chunk of it
            kept: list[dict[str, Promoted]] = []
            clients = {"one": lab.one.client, "two": lab.two.client}
            done = switch_all(clients, record, lambda promoted: kept.append(dict(promoted)))
            assert [(each.robot, each.worker, bool(each.why)) for each in done] == [
                ("one", "solo", False),
                ("two", "solo", True),
                ("two", "scripted", False),
                ("one", "scripted", False),
            ]
            assert "worker 'solo' is not alive" in done[1].why
            assert [set(each) for each in kept] == [{"one"}, {"one", "two"}, set()]
            assert lab.obeyed() == ["scripted", "scripted"]
            for chain in lab.both:
                assert chain.state() == "active"
