"""A trial that a person runs and judges on the page, blind to the model."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from shutil import rmtree
from typing import Any

import pytest
from camera_rig import until
from chain import Chain
from web_rig import Browser, Site, browsing, serving, write_people

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.trial.folder import TrialFolder
from vla_zenoh.lab.trial.verdict import EpisodeVerdict, verdict_in

pytestmark = pytest.mark.long

pytest.importorskip("starlette", reason="needs the extra web")
pytest.importorskip("uvicorn", reason="needs the extra web")

PLAN: dict[str, Any] = {
    "do": "trial",
    "workers": "scripted",
    "episodes": 2,
    "seconds": 30,
    "blind": True,
}
PATIENCE_S = 20.0
MIDDLE_M = 0.42


@pytest.fixture(scope="module")
def site(shared_chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    people = write_people(tmp_path_factory.mktemp("people"))
    with serving(shared_chain.profile_file, people) as site:
        yield site


def plan(chain: Chain, name: str) -> dict[str, Any]:
    """A trial that has room to move."""
    prompt = "HARD: go up" if chain.height_m() < MIDDLE_M else chain.down
    return {**PLAN, "prompt": prompt, "name": name}


@pytest.fixture(autouse=True)
def _no_trial(chain: Chain, site: Site) -> None:
    """What a test that failed has left would be in the way when it is tried again."""
    with browsing(site) as page:
        if (page.state.get("trial") or {}).get("on"):
            assert page.ask(do="end_trial")["is"] == "done"
            until("it ended", lambda: not page.state["trial"]["on"], PATIENCE_S)
    rmtree(chain.profile_file.parent / "runs", ignore_errors=True)


def phase(page: Browser, *wanted: str) -> dict[str, Any]:
    """The trial on the page, once it is in one of these phases."""

    def found() -> dict[str, Any] | None:
        trial = page.state.get("trial") or {}
        return trial if trial.get("phase") in wanted else None

    return until(f"phase {wanted}, {page.state.get('trial')}", found, PATIENCE_S)


def answer(page: Browser, line: str, *wanted: str) -> None:
    page.send(do="answer", number=phase(page, *wanted)["number"], line=line)


def runs(page: Browser) -> dict[str, Any]:
    """Say that the scene is ready, again where something was not yet, until the arm moves."""
    give_up_s = time.monotonic() + 2 * PATIENCE_S
    answer(page, "", "setup")
    while (trial := phase(page, "blocked", "run"))["phase"] != "run":
        assert time.monotonic() < give_up_s
        page.send(do="answer", number=trial["number"], line="")  # a second one is none
        time.sleep(0.5)
    return trial


def verdicts(chain: Chain, name: str) -> list[EpisodeVerdict]:
    return TrialFolder(chain.profile_file.parent / "runs" / name).episodes()


def test_a_person_judges_a_blind_trial_and_the_folder_is_as_the_terminal_writes_it(
    chain: Chain, site: Site
) -> None:
    with browsing(site) as page:
        assert page.ask(**plan(chain, "blind"))["is"] == "done"
        until("masked states", lambda: page.state["trial"].get("phase") == "setup")
        page.heard.clear()
        seen = runs(page)
        assert seen["seconds"] == 30
        chain.until("it moves", chain.moves)
        told = json.dumps([*page.heard, page.state])
        assert "scripted" not in told
        assert "[worker]" in told
        answer(page, "", "run")
        answer(page, "y lifted, criterion 2", "judge")
        assert phase(page, "setup")["at"] == 2
        assert page.state["trial"]["notes"] == ["lifted, criterion 2"]
        page.send(do="runs")
        listed = page.wait("runs")["runs"]
        assert {run["closed"] for run in listed} == {"its trial is blind and not finished"}
        page.send(do="make", name=listed[0]["name"], kind="report")
        assert "not finished" in page.wait("made")["why"]
        runs(page)
        answer(page, "n dropped", "run")  # a verdict ends it, and is the verdict
        until("the result", lambda: "finished" in page.state["trial"].get("text", ""), PATIENCE_S)
        until("names are told again", lambda: "scripted 1 of 2" in page.state["trial"]["text"])
        page.heard.clear()
        page.send(do="runs")
        said = {run["name"]: run["said"] for run in page.wait("runs")["runs"]}
        assert said == {
            "blind/episode-0001.mcap": "success lifted, criterion 2",
            "blind/episode-0002.mcap": "failure dropped",
        }
    first, second = verdicts(chain, "blind")
    assert (first.verdict, first.note, first.worker) == (
        "success",
        "lifted, criterion 2",
        "scripted",
    )
    assert (second.verdict, second.end) == ("failure", "person")
    file = open_recording(chain.profile_file.parent / "runs" / "blind" / first.recording)
    assert not list(file.entries(lambda _: False))
    assert verdict_in(file.ended, "scripted") == "success"


def test_an_episode_that_nobody_watches_is_braked_and_waits_for_its_verdict(
    chain: Chain, site: Site
) -> None:
    with browsing(site) as page:
        assert page.ask(**plan(chain, "left"))["is"] == "done"
        runs(page)
        chain.until("it moves", chain.moves)
        page.watches = False  # a hidden tab, a sleeping tablet
        chain.until("inactive", lambda: chain.state() == "inactive")
        assert "hidden" in phase(page, "judge")["text"]
        page.watches = True
        answer(page, "x", "judge")
        runs(page)
        chain.until("it moves", chain.moves)
        page.vanish()
        chain.until("inactive", lambda: chain.state() == "inactive")
    with browsing(site) as other:  # another page goes on with it
        answer(other, "n", "judge")
        phase(other, "setup")
        assert other.ask(do="end_trial")["is"] == "done"
        until("it ended", lambda: not other.state["trial"]["on"])
    assert [each.verdict for each in verdicts(chain, "left")] == ["void", "failure"]


def test_a_stop_ends_an_episode_and_an_old_answer_is_none(chain: Chain, site: Site) -> None:
    with browsing(site) as page:
        assert page.ask(**plan(chain, "stopped"))["is"] == "done"
        old = phase(page, "setup")["number"]
        runs(page)
        chain.until("it moves", chain.moves)
        page.send(do="stop")
        assert page.wait("stopped")["stopped"]
        phase(page, "judge")
        page.send(do="answer", number=old, line="y")
        time.sleep(0.5)
        answer(page, "n stopped", "judge")
        assert "check that it may move" in phase(page, "setup")["text"]
        assert page.ask(do="end_trial")["is"] == "done"
        until("it ended", lambda: not page.state["trial"]["on"])
        assert page.ask(do="reset")["is"] == "done"
    (only,) = verdicts(chain, "stopped")
    assert (only.verdict, only.end, only.note) == ("failure", "stopped", "stopped")


def test_a_trial_that_cannot_be_is_named(chain: Chain, site: Site) -> None:
    blind = plan(chain, "blind")
    with browsing(site) as page:
        assert page.ask(**blind)["is"] == "done"
        assert page.ask(do="end_trial")["is"] == "done"
        until("it ended", lambda: not page.state["trial"]["on"], PATIENCE_S)
        for change, why in (
            ({"name": "../away"}, "cannot be part of a key"),
            ({"name": "new", "workers": ""}, "say models and prompt"),
            ({"name": "new", "workers": "a, a"}, "twice"),
            ({"name": "blind", "prompt": "another"}, "has another plan"),
        ):
            found = page.ask(**{**blind, **change})
            assert found["is"] == "failed", change
            assert why in found["why"]
        assert not page.state["trial"].get("on")
