"""Plan, rules, judges, webhook and page of an unattended trial, without a robot."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vla_zenoh_nights import runner
from vla_zenoh_nights.judge import Frame, JudgedEpisode, make_judge
from vla_zenoh_nights.operator import film_strip, strip_path
from vla_zenoh_nights.plan import (
    JudgeChoice,
    StopRules,
    UnattendedPlan,
    checked_plan,
    read_plan,
)
from vla_zenoh_nights.runner import Webhook
from vla_zenoh_nights.trial import JOURNAL, PAGE, UnattendedTrial, write_page
from vla_zenoh_trial.folder import TrialFolder
from vla_zenoh_trial.verdict import EpisodeVerdict

from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.errors import NodeError, OutputError, RecordError
from vla_zenoh.types import Image

PLAN: dict[str, Any] = {
    "workers": ["a", "b"],
    "tasks": [{"name": "up", "prompt": "go up", "episodes": 2, "seconds": 5}],
    "reset": {"simulator": True},
    "judge": {"file": "judge.py"},
    "seed": 7,
}
GOOD = EpisodeVerdict(
    1, 1, 1, "a", "success", "", "policy", "", 1.5, 3, 0, 10**18, None, "episode-0001.mcap", 0
)
BAD = replace(GOOD, verdict="failure", end="time")
VOID = replace(GOOD, verdict="void", end="lost", why="node 'sim' is gone")
CONTACT = replace(
    GOOD, verdict="failure", end="lost", why="something presses against the arm: contact_force 50 N"
)
REFUSED = replace(GOOD, verdict="void", end="refused", why="worker a is not alive")


def plan_with(**changed: Any) -> UnattendedPlan:
    return checked_plan({**PLAN, **changed}, "plan.yaml")


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"reset": {}}, "reset: give one of"),
        ({"reset": {"simulator": True, "primitive": "home"}}, "reset: give one of"),
        ({"reset": {"worker": "tidy"}}, "worker and prompt belong together"),
        ({"judge": {"simulator": True}}, "the simulator's judge needs order in task up"),
        ({"judge": {"url": "ftp://x"}}, "url begins with"),
        ({"workers": ["a", "a"]}, "names one of them twice"),
        ({"tasks": [PLAN["tasks"][0]] * 2}, "two tasks have one name"),
        ({"tasks": [{**PLAN["tasks"][0], "name": "../x"}]}, "tasks.0.name"),
        ({"stop": {"at": "6 o'clock"}}, "stop.at"),
        ({"episode": 3}, "episode"),
    ],
)
def test_a_wrong_plan_names_what_is_wrong(changed: Mapping[str, Any], named: str) -> None:
    with pytest.raises(RecordError, match=r"plan\.yaml") as caught:
        plan_with(**changed)
    assert named in str(caught.value)


def test_an_empty_plan_names_what_is_missing() -> None:
    with pytest.raises(RecordError, match=r"plan\.yaml: workers: is missing; tasks: is missing"):
        checked_plan({}, "plan.yaml")


def test_a_plan_is_yaml_with_a_time_of_day_and_an_order(tmp_path: Path) -> None:
    file = tmp_path / "plan.yaml"
    file.write_text(
        "workers: [brick]\n"
        "tasks:\n"
        "  - {name: red, prompt: put it in, episodes: 3, order: {family: put, target: red}}\n"
        "reset: {simulator: true}\n"
        "judge: {simulator: true}\n"
        'stop: {at: "06:30"}\n'
    )
    plan = read_plan(file)
    order = plan.tasks[0].order
    assert order is not None
    assert (order.family, order.target) == ("put", "red")
    evening = datetime(2026, 11, 23, 19, tzinfo=UTC).timestamp()
    morning = datetime(2026, 11, 24, 6, 30, tzinfo=UTC).timestamp()
    assert plan.stop.deadline(evening, UTC) == morning
    assert plan.stop.deadline(morning - 1, UTC) == morning
    assert checked_plan(json.loads(plan.model_dump_json()), "again") == plan


def test_rules_stop_after_contacts_refusals_failures_and_voids() -> None:
    rules = StopRules(contacts=2, refusals=2, failures_in_a_row=3, voids_in_a_row=3)
    assert rules.reason([]) == ""
    assert rules.reason([CONTACT, GOOD, BAD]) == ""
    assert rules.reason([CONTACT, GOOD, CONTACT]) == "contacts: 2"
    assert rules.reason([REFUSED, GOOD, REFUSED]) == "refusals: 2"
    assert rules.reason([BAD, BAD, GOOD, BAD]) == ""
    assert rules.reason([BAD, VOID, BAD, BAD]) == "failures_in_a_row: 3"
    assert rules.reason([VOID, VOID, VOID]) == "voids_in_a_row: 3"


def test_after_a_stop_the_rules_count_anew_and_after_a_crash_they_do_not(tmp_path: Path) -> None:
    trial = UnattendedTrial(tmp_path, plan_with(stop={"contacts": 2}), "arm")
    trial.begin()
    folder, plan = trial.trial(trial.plan.tasks[0])
    folder.path.mkdir()
    folder.begin(plan)
    folder.append(CONTACT)
    again = UnattendedTrial(tmp_path, None, "arm")  # after a crash
    again.begin()
    folder.append(replace(CONTACT, number=2))
    assert again.due_to_stop() == "contacts: 2"
    again.note("stopped", "contacts: 2")
    again.begin()
    assert again.due_to_stop() == ""


def test_a_journal_line_that_a_power_cut_truncated_is_none(tmp_path: Path) -> None:
    trial = UnattendedTrial(tmp_path, plan_with(), "arm")
    trial.begin()
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(b'\n{"what": "tro')
    trial.note("finished")
    assert [line["what"] for line in trial.journal()] == ["begun", "finished"]


def test_another_plan_is_rejected_by_the_name_of_what_differs(tmp_path: Path) -> None:
    UnattendedTrial(tmp_path, plan_with(), "arm").begin()
    with pytest.raises(OutputError, match="seed differ"):
        UnattendedTrial(tmp_path, plan_with(seed=8), "arm")


def a_picture(value: int) -> bytes:
    return encode_jpeg(Image(np.full((24, 32, 3), value, np.uint8)))


@pytest.fixture
def seen() -> JudgedEpisode:
    frames = [Frame(float(t), {"front": a_picture(20 * t)}) for t in range(10)]
    return JudgedEpisode("go up", "policy", frames)


def test_a_python_judge_gets_pictures_and_its_errors_name_the_file(
    tmp_path: Path, seen: JudgedEpisode
) -> None:
    (tmp_path / "judge.py").write_text(
        "def judge(episode):\n    return episode.picture('front').mean() > 100, 'bright\\nenough'\n"
    )
    judge = make_judge(JudgeChoice(file="judge.py"), tmp_path)
    assert judge is not None
    assert judge(seen) == (True, "bright enough")
    (tmp_path / "judge.py").write_text("def judge(episode):\n    return episode.depth\n")
    judge = make_judge(JudgeChoice(file="judge.py"), tmp_path)
    assert judge is not None
    with pytest.raises(NodeError, match=r"judge\.py: AttributeError"):
        judge(seen)
    (tmp_path / "judge.py").write_text("def judge(episode):\n    return 'maybe'\n")
    judge = make_judge(JudgeChoice(file="judge.py"), tmp_path)
    assert judge is not None
    with pytest.raises(NodeError, match="returned 'maybe'"):
        judge(seen)
    (tmp_path / "judge.py").write_text("")
    with pytest.raises(NodeError, match="define judge"):
        make_judge(JudgeChoice(file="judge.py"), tmp_path)


class Peer(HTTPServer):
    """Keeps what is posted to it."""

    def __init__(self, answer: Mapping[str, Any]) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.answer, self.posted = answer, list[Any]()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/v1/chat/completions"


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        assert isinstance(self.server, Peer)
        body = self.rfile.read(int(self.headers["content-length"]))
        self.server.posted.append(json.loads(body))
        answer = json.dumps(self.server.answer).encode()
        self.send_response(200)
        self.send_header("content-length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def a_peer(answer: Mapping[str, Any]) -> Iterator[Peer]:
    with Peer(answer) as peer:
        thread = threading.Thread(target=peer.serve_forever)
        thread.start()
        try:
            yield peer
        finally:
            peer.shutdown()
            thread.join()


def said(text: str) -> Mapping[str, Any]:
    return {"choices": [{"message": {"content": text}}]}


def test_a_model_judges_by_pictures_and_its_answer_is_the_note(seen: JudgedEpisode) -> None:
    with a_peer(said("No, the brick\nlies beside the box.")) as peer:
        judge = make_judge(JudgeChoice(url=peer.url, model="a-vlm"), Path())
        assert judge is not None
        assert judge(seen) == (False, "No, the brick lies beside the box.")
    (posted,) = peer.posted
    text, *pictures = posted["messages"][0]["content"]
    assert "go up" in text["text"]
    assert len(pictures) == 6
    assert all(each["image_url"]["url"].startswith("data:image/jpeg;base64,") for each in pictures)


@pytest.mark.parametrize("answer", [said("Perhaps."), {"choices": []}])
def test_an_answer_that_is_none_is_no_verdict(
    seen: JudgedEpisode, answer: Mapping[str, Any]
) -> None:
    with a_peer(answer) as peer:
        judge = make_judge(JudgeChoice(url=peer.url), Path())
        assert judge is not None
        with pytest.raises(NodeError, match=peer.url):
            judge(seen)


def test_a_webhook_is_told_in_order_and_a_dead_one_warns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(runner, "BACK_OFF_S", 0.01)
    warnings: list[str] = []
    with a_peer({}) as peer:
        hook = Webhook(peer.url, warnings.append)
        hook.tell("begun", {"robot": "arm"})
        hook.tell("finished", {})
        hook.close()
        assert [each["what"] for each in peer.posted] == ["begun", "finished"]
        assert peer.posted[0]["robot"] == "arm"
        dead = peer.url
    assert not warnings
    hook = Webhook(dead, warnings.append)
    hook.tell("begun", {})
    hook.close(20.0)
    assert "'begun' was not delivered" in warnings[0]


def test_the_page_has_rates_strips_recordings_and_what_happened(
    tmp_path: Path, seen: JudgedEpisode
) -> None:
    trial = UnattendedTrial(tmp_path, plan_with(), "arm")
    trial.begin()
    folder, plan = trial.trial(trial.plan.tasks[0])
    folder.path.mkdir()
    folder.begin(plan)
    for each in (GOOD, replace(BAD, worker="b", note="<b>fell</b>"), replace(VOID, setup=2)):
        folder.append(each)
    strip = film_strip(seen.chosen())
    assert strip is not None
    strip_path(folder, 1, "a").write_bytes(strip)
    (folder.path / GOOD.recording).touch()
    trial.note("trouble", "the nodes did not come up")
    write_page(trial)
    page = (tmp_path / PAGE).read_text()
    assert "2 of 4 episodes, robot arm" in page
    assert "100.0 %" in page
    assert "20.7 to 100.0 %" in page
    assert 'src="up/setup-0001-a.jpg"' in page
    assert 'href="up/episode-0001.mcap"' in page
    assert "the nodes did not come up" in page
    assert "&lt;b&gt;fell&lt;/b&gt;" in page
    assert TrialFolder(tmp_path / "up").episodes()[2].why in page.replace("&#39;", "'")
