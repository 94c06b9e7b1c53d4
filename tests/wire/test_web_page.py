"""The page at a robot at work: its command as a process, browsers over real WebSockets."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import PATIENCE_S, until
from chain import READY_PATIENCE_S, Chain
from vla_zenoh_web.hold import HOLD_S
from web_rig import (
    METRICS,
    OPERATOR,
    PEOPLE,
    VIEWER,
    Browser,
    Site,
    browsing,
    serving,
    write_people,
)

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.verdict import verdict_in

pytestmark = pytest.mark.long

pytest.importorskip("starlette", reason="needs vla-zenoh-web")
pytest.importorskip("uvicorn", reason="needs vla-zenoh-web")
parser = pytest.importorskip("prometheus_client.openmetrics.parser")

from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

GARBAGE = 10_000
STILL_MM = 2.0
STOPS = 4
SHOWN_OUT_S = 10.0
"""The file is looked at once a second; a minute is the promise."""
END_S = 90.0
"""An export of one short episode on a busy computer."""
BRAKE_S = 0.5
"""A brake from the speed of these motions, on a busy computer."""


@pytest.fixture(scope="module")
def site(shared_chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    people = write_people(tmp_path_factory.mktemp("people"))
    with serving(shared_chain.profile_file, people) as site:
        yield site


def hold_until_it_moves(chain: Chain, browser: Browser) -> None:
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.42 else chain.down)
    browser.hold_until("it moves", chain.moves, READY_PATIENCE_S)


def stop_in_motion(chain: Chain, browser: Browser) -> dict[str, Any]:
    """The page's report of a stop; again where a busy computer had ended the hold before it."""
    for _ in range(STOPS):
        hold_until_it_moves(chain, browser)
        chain.client.pop_events()
        browser.heard.clear()
        browser.send(do="stop")
        report = browser.wait("stopped")
        chain.until("stopped", lambda: chain.state() == "stopped")
        if chain.events("active->stopped"):
            return report
        browser.let_go()
        assert browser.ask(do="reset")["is"] == "done"
    raise AssertionError("each hold ended before its stop")


def stopped_ns(chain: Chain) -> int:
    """When the command node took a stop: a page's own word for it is under way for some time."""
    chain.until("stopped", lambda: chain.state() == "stopped" and chain.events("active->stopped"))
    events = [(header, event.what) for _, header, event in list(chain.client.events)]
    return next(header.stamp_wall_ns for header, what in events if what == "active->stopped")


def test_a_stop_of_the_page_says_which_robot_stood_when(chain: Chain, site: Site) -> None:
    with browsing(site) as browser, browsing(site, VIEWER) as other:
        report = stop_in_motion(chain, browser)
        since_ns = stopped_ns(chain)
        assert report["robot"] == chain.profile.robot.name
        assert report["by"] == "anna"
        assert report["outcome"] == "confirmed"
        assert report["message"].startswith(f"CONFIRMED: robot {report['robot']} is stopped")
        assert 0 < report["stopped_s"] <= report["stands_s"]
        assert other.wait("stopped", lambda message: message == report)
        chain.wait_still()
        assert chain.recorder.track(since_ns).time_to_stand_s(since_ns) <= report["stands_s"] + 0.1
        assert browser.ask(do="activate")["is"] == "failed"
        assert browser.ask(do="reset")["text"] == "cleared; inactive"
        chain.until("inactive", lambda: chain.state() == "inactive")


def test_a_stop_goes_by_post_where_the_socket_is_broken(chain: Chain, site: Site) -> None:
    ours = {"Origin": f"http://{site.host}", "Authorization": f"Bearer {OPERATOR}"}
    status, _, body = site.ask("POST", "/stop", ours)
    assert status == 200
    assert json.loads(body)["outcome"] == "confirmed"
    chain.until("stopped", lambda: chain.state() == "stopped")


def test_nobody_else_stops_by_post(chain: Chain, site: Site) -> None:
    ours = {"Origin": f"http://{site.host}", "Authorization": f"Bearer {OPERATOR}"}
    for change in (
        {"Authorization": "Bearer another"},
        {"Authorization": ""},
        {"Authorization": f"Bearer {VIEWER}"},
        {"Origin": "http://evil.example"},
        {"Origin": ""},
        {"Host": "evil.example"},
    ):
        assert site.ask("POST", "/stop", {**ours, **change})[0] == 403, change
    assert chain.state() == "inactive"


def test_the_arm_runs_while_the_button_is_held_and_brakes_when_let_go(
    chain: Chain, site: Site
) -> None:
    with browsing(site) as browser:
        hold_until_it_moves(chain, browser)
        until("the page says so", lambda: browser.state["you_hold"])
        assert browser.state["held_by"].startswith("web-anna-")
        time.sleep(2 * HOLD_S)  # echoes keep it
        assert chain.state() == "active"
        browser.let_go()
        chain.until("inactive", lambda: chain.state() == "inactive")
        chain.wait_still()
        # A person let go: that is nothing to be told about at the next activation.
        assert chain.detail("why") == "deactivated"


def test_a_closed_tab_brakes_the_arm(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        hold_until_it_moves(chain, browser)
        since_ns = time.time_ns()
        browser.vanish()
        chain.until("inactive", lambda: chain.state() == "inactive")
        chain.wait_still()
        assert chain.recorder.track(since_ns).time_to_stand_s(since_ns) < HOLD_S + BRAKE_S


def test_a_tablet_that_sleeps_brakes_the_arm(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        hold_until_it_moves(chain, browser)
        since_ns = time.time_ns()
        browser.freeze()
        chain.until("inactive", lambda: chain.state() == "inactive")
        chain.wait_still()
        assert chain.recorder.track(since_ns).time_to_stand_s(since_ns) < HOLD_S + BRAKE_S


def test_echoes_that_a_network_kept_back_do_not_keep_the_arm_in_motion(
    chain: Chain, site: Site
) -> None:
    with browsing(site) as browser:
        hold_until_it_moves(chain, browser)
        browser.echoes = False
        browser.wait("hold_ended")
        chain.until("inactive", lambda: chain.state() == "inactive")
        browser.echoes = True  # the network is well again: the same press stays ended
        time.sleep(2 * HOLD_S)
        assert chain.state() == "inactive"


def test_a_killed_server_brakes_the_arm(chain: Chain, site: Site) -> None:
    people = write_people(chain.profile_file.parent)
    with serving(chain.profile_file, people) as second:
        browser = Browser(second)
        hold_until_it_moves(chain, browser)
        os.kill(second.process.pid, signal.SIGKILL)
        second.process.wait()
        chain.until("inactive", lambda: chain.state() == "inactive")
    chain.wait_still()


def test_who_is_taken_out_of_the_file_is_shown_out_and_the_arm_brakes(
    chain: Chain, tmp_path: Path
) -> None:
    people = write_people(tmp_path)
    with (
        serving(chain.profile_file, people) as own,
        browsing(own) as browser,
        browsing(own, VIEWER) as other,
    ):
        hold_until_it_moves(chain, browser)
        began_s = time.monotonic()
        write_people(tmp_path, {name: one for name, one in PEOPLE.items() if name != "anna"})
        until("she is shown out", browser.closed.is_set, SHOWN_OUT_S)
        chain.until("inactive", lambda: chain.state() == "inactive")
        chain.wait_still()
        print(f"out, and the arm stands, after {time.monotonic() - began_s:.2f} s")
        assert "no longer among the people" in browser.answers("denied")[0]["why"]
        again = Browser(own)
        again.wait("denied")
        again.close()
        ours = {"Origin": f"http://{own.host}", "Authorization": f"Bearer {OPERATOR}"}
        assert own.ask("POST", "/stop", ours)[0] == 403
        assert not other.closed.is_set()


def test_only_one_page_holds(chain: Chain, site: Site) -> None:
    with browsing(site) as one, browsing(site) as other:
        hold_until_it_moves(chain, one)
        other.hold()
        assert other.wait("hold_ended", lambda m: m.get("why"))["why"] == (
            "another page holds the arm"
        )
        other.let_go()
        time.sleep(2 * HOLD_S)
        assert chain.state() == "active"
        one.let_go()


def test_no_other_page_changes_how_the_arm_moves_under_a_finger(chain: Chain, site: Site) -> None:
    def jog(browser: Browser, *, on: bool, level: int) -> dict[str, Any]:
        return browser.ask(do="jog", on=on, frame="base", level=level, part="")

    with browsing(site) as one, browsing(site) as other:
        assert jog(one, on=True, level=3)["is"] == "done"
        one.twist = [0.0, 0.0, 1.0 if chain.height_m() < 0.42 else -1.0, 0.0, 0.0, 0.0]
        hold_until_it_moves(chain, one)
        for answer in (jog(other, on=True, level=4), jog(other, on=False, level=0)):
            assert "another page holds the arm" in answer["why"]
        assert other.state["hand"]["level"] == 3
        assert other.state["task"]["worker"] == "teleop"
        other.send(do="stop")
        assert one.wait("stopped")["outcome"] == "confirmed"
        one.let_go()
        assert other.ask(do="reset")["is"] == "done"
        assert jog(other, on=False, level=0)["is"] == "done"


def test_an_activation_is_rejected_with_every_reason_in_words(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        assert browser.ask(do="prompt", text="dance")["is"] == "done"
        assert browser.ask(do="worker", name="nobody")["is"] in ("done", "failed")
        answer = browser.ask(do="activate")
        assert answer["is"] == "failed"
        assert answer["why"] == "activate rejected"
        assert len(answer["reasons"]) >= 1
        assert any("nobody" in reason for reason in answer["reasons"])


def test_settings_of_the_page_are_those_of_the_robot(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        for request, field, value in (
            ({"do": "prompt", "text": "HARD: go up x5"}, "prompt", "HARD: go up x5"),
            ({"do": "rate", "hz": 7}, "rate_hz", 7),
            ({"do": "speed", "percent": 40}, "speed_percent", 40),
        ):
            assert browser.ask(**request)["is"] == "done"
            until(f"the page shows {field}", lambda f=field, v=value: browser.state["task"][f] == v)
        assert browser.ask(do="speed", percent=400)["is"] == "failed"


def test_what_the_gripper_holds_is_said_and_drawn(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        assert browser.ask(do="held", part="", text="0.04 0.06 0.1 at 0 0 0.02")["is"] == "done"
        try:
            until("it is drawn", lambda: "held_m" in browser.state["arms"][""])
            corners_m = np.array(browser.state["arms"][""]["held_m"])
            edges_m = np.linalg.norm(corners_m[[1, 2, 4]] - corners_m[0], axis=1)
            assert edges_m == pytest.approx([0.04, 0.06, 0.1], abs=1e-3)
            tcp_m = browser.state["arms"][""]["measured_m"]
            assert np.linalg.norm(corners_m.mean(axis=0) - tcp_m) == pytest.approx(0.02, abs=1e-3)
            for text, part in (("0.04", ""), ("a b c", ""), ("0.1 0.1 0.1", "left")):
                assert browser.ask(do="held", part=part, text=text)["is"] == "failed"
        finally:
            emptied = browser.ask(do="held", part="", text="")
        assert emptied["is"] == "done"
        until("it is gone", lambda: "held_m" not in browser.state["arms"][""])


def test_a_person_takes_the_arm_by_hand_and_gives_it_back(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        assert browser.ask(do="jog", on=True, frame="base", level=2, part="")["is"] == "done"
        until("the page has the arm", lambda: browser.state["jog"])
        before_m = chain.measured().position_m
        browser.twist = [0.0, 0.0, 1.0 if before_m[2] < 0.42 else -1.0, 0.0, 0.0, 0.0]
        hold_until_it_moves(chain, browser)
        chain.until("it went", lambda: abs(chain.measured().position_m[2] - before_m[2]) > 0.02)
        browser.let_go()
        chain.wait_still()
        assert abs(chain.measured().position_m[:2] - before_m[:2]).max() * 1e3 < STILL_MM
        assert browser.ask(do="jog", on=False, frame="base", level=2, part="")["is"] == "done"
        until("the model has it", lambda: browser.state["task"]["worker"] == "scripted")


def end_recording(browser: Browser) -> None:
    """One that a test which failed has left; without one it is rejected."""
    browser.ask(do="record", on=False, verdict="", note="")


def test_a_recording_ends_with_the_verdict_of_a_person(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        end_recording(browser)
        begun = browser.ask(do="record", on=True, verdict="", note="")
        assert begun["is"] == "done", begun
        assert browser.ask(do="record", on=True, verdict="", note="")["is"] == "failed"
        time.sleep(1.0)
        ended = browser.ask(do="record", on=False, verdict="success", note="went well")
        assert ended["is"] == "done", ended
    *_, path = sorted((chain.profile_file.parent / "runs").glob("web-*.mcap"))
    file = open_recording(path)
    assert not list(file.entries(lambda _: False))  # what is told at the end is known there
    assert verdict_in(file.ended, "scripted") == "success"
    assert (file.ended or {})["trial"]["note"] == "went well"


def test_pictures_come_newest_first_and_no_faster_than_they_are_drawn(
    chain: Chain, site: Site
) -> None:
    with site.connect("/pictures") as socket:
        socket.send(json.dumps({"do": "enter", "token": OPERATOR}))
        socket.send(json.dumps({"do": "look", "streams": ["camera/front"], "hz": 20}))
        first = socket.recv(PATIENCE_S)
        assert isinstance(first, bytes)
        head, _, jpeg = first.partition(b"\n")
        assert json.loads(head)["name"] == "camera/front"
        assert jpeg[:2] == b"\xff\xd8"
        newest = json.loads(bytes(socket.recv(PATIENCE_S)).partition(b"\n")[0])
        with pytest.raises(TimeoutError):  # nothing was drawn: two are on the way at most
            socket.recv(1.0)
        socket.send(json.dumps({"do": "drawn", "frame": 2}))
        later = json.loads(bytes(socket.recv(PATIENCE_S)).partition(b"\n")[0])
        assert later["stamp_ms"] > newest["stamp_ms"] + 500  # none that waited


def test_what_the_model_sees_is_offered(chain: Chain, site: Site) -> None:
    chain.client.set_worker("scripted")
    with browsing(site) as browser:
        until("streams", lambda: "seen" in browser.state and browser.state["seen"])
        (name, *_) = browser.state["seen"]
    with site.connect("/pictures") as socket:
        socket.send(json.dumps({"do": "enter", "token": OPERATOR}))
        socket.send(json.dumps({"do": "look", "streams": [name], "hz": 20}))
        assert isinstance(socket.recv(PATIENCE_S), bytes)


def test_a_viewer_looks_at_states_and_nothing_else(chain: Chain, site: Site) -> None:
    with browsing(site, VIEWER) as viewer:
        assert viewer.answers("welcome")[0]["pictures"] == []
        for request in (
            {"do": "prompt", "text": "HARD: go down"},
            {"do": "activate"},
            {"do": "stop"},
            {"do": "speed", "percent": 5},
            {"do": "invite", "name": "eve", "role": "operator"},
        ):
            viewer.heard.clear()
            viewer.send(**request)
            assert "viewer" in viewer.wait("rejected")["why"]
        viewer.hold()
        time.sleep(HOLD_S)
        assert chain.state() == "inactive"
        task = chain.client.task
        assert task is not None
        assert (task.prompt, task.speed_percent) == ("hold", 100)
    with site.connect("/pictures") as socket:
        socket.send(json.dumps({"do": "enter", "token": VIEWER}))
        with pytest.raises(ConnectionClosed):
            socket.recv(PATIENCE_S)


def test_an_operator_invites_a_person_who_has_the_rights_that_were_given(
    chain: Chain, site: Site
) -> None:
    with browsing(site) as browser:
        browser.send(do="invite", name="carl", role="viewer")
        token = browser.wait("invited")["token"]
        browser.send(do="invite", name="carl", role="operator")
        assert "carl already" in browser.wait("failed")["why"]
        browser.wait("event", lambda event: "anna lets carl in, as viewer" in event["why"])
        with browsing(site, token) as other:
            assert other.answers("welcome")[0]["person"] == "carl"
            until("both", lambda: len(browser.state["people"]) == 2)
            assert [(one["name"], one["role"]) for one in browser.state["people"]] == [
                ("anna", "operator"),
                ("carl", "viewer"),
            ]
            other.send(do="stop")
            assert "viewer" in other.wait("rejected")["why"]
        until("carl left", lambda: len(browser.state["people"]) == 1)


def test_the_banner_says_in_plain_words_what_the_arm_does(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        hold_until_it_moves(chain, browser)
        until("who holds", lambda: "anna" in browser.state["banner"]["what"])
        assert browser.state["people"][0]["holds"]
        browser.let_go()
        until("it stands", lambda: browser.state["banner"]["do"] == "Ready: hold to run.")


def test_the_guide_records_a_take_and_makes_the_data_set(chain: Chain, site: Site) -> None:
    def guide(browser: Browser, step: str) -> dict[str, Any]:
        prompt = "HARD: go up" if chain.height_m() < 0.42 else chain.down
        return browser.ask(do="guide", step=step, prompt=prompt, count=1)

    def at(step: str) -> bool:
        return browser.state["guide"]["step"] == step

    with browsing(site) as browser:
        assert guide(browser, "begin")["is"] == "done"
        assert guide(browser, "take")["is"] == "done"
        refused = browser.ask(do="record", on=False, verdict="", note="")
        assert "episode of the guide" in refused["why"]
        browser.hold_until("it moves", chain.moves, READY_PATIENCE_S)
        browser.let_go()
        until("to be judged", lambda: at("judge"))
        assert guide(browser, "success")["is"] == "done"
        until("the data set", lambda: at("done"), END_S)
        text = browser.state["guide"]["text"]
    found = re.match(r"(\S+/dataset): (\d+) episodes \((\d+) success\)", text)
    assert found, text
    assert found[2] == found[3]
    info = json.loads((chain.profile_file.parent / found[1] / "meta/info.json").read_text())
    assert info["total_episodes"] == int(found[2])


def test_a_wrong_token_opens_nothing(chain: Chain, site: Site) -> None:
    for path in ("/control", "/pictures"):
        for first in (
            {"do": "enter", "token": "another token altogether"},
            {"do": "stop"},
            "nonsense",
        ):
            with site.connect(path) as socket:
                socket.send(json.dumps(first))
                assert json.loads(socket.recv(PATIENCE_S))["is"] == "denied"
                with pytest.raises(ConnectionClosed):
                    socket.recv(PATIENCE_S)
    assert chain.state() == "inactive"


def test_pages_of_other_sites_and_other_names_are_turned_away(chain: Chain, site: Site) -> None:
    for origin, host in (
        ("http://evil.example", None),
        ("null", None),
        (f"https://{site.host}", None),
        (f"http://evil.example:{site.port}", f"evil.example:{site.port}"),
    ):
        with pytest.raises(InvalidStatus), site.connect(origin=origin, host=host):
            pass
    assert site.ask("GET", "/", {"Host": "evil.example"})[0] == 403
    assert site.ask("GET", "/", {"Host": f"localhost:{site.port}"})[0] == 200


def test_the_page_asks_no_other_host_and_runs_no_inline_script(site: Site) -> None:
    for path in ("/", "/page.js", "/page.css"):
        status, headers, body = site.ask("GET", path)
        assert status == 200
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        text = body.decode()
        assert "http://" not in text
        assert "https://" not in text
        assert "innerHTML" not in text
        assert "<script>" not in text
        assert " style=" not in text


@pytest.mark.slow
def test_garbage_moves_nothing_and_ends_nothing(chain: Chain, site: Site) -> None:
    chance = random.Random(7)
    words = [
        "", "{", "[]", "null", "1e999", '{"do": 1}', '{"do": "fly"}', '{"do": "prompt"}',
        '{"do": "prompt", "text": "\\ud800"}', '{"do": "rate", "hz": NaN}',
        '{"do": "rate", "hz": ' + "9" * 3000 + "}", "[" * 4000,
        '{"do": "beat", "press": 1, "tick": 1e400, "twist": [9,0,0,0,0,0], "opening": 0}',
        '{"do": "hold", "press": -1, "tick": 0, "hand": false}',
        '{"do": "hold", "press": 1, "tick": 9007199254740991, "hand": false}',
        '{"do": "look", "streams": ["../x"], "hz": 1}', '{"do": "enter", "token": "x"}',
    ]  # fmt: skip
    with browsing(site) as browser:
        for number in range(GARBAGE):
            if number % 3 == 0:
                browser.connection.send(chance.randbytes(chance.randrange(200)))
            else:
                browser.connection.send(chance.choice(words))
        # In between, what is meant is obeyed.
        time.sleep(1.0)
        assert browser.ask(do="rate", hz=6)["is"] == "done"
        counted = browser.wait("nodes", lambda m: m["counters"].get("bad_message", 0) >= GARBAGE)
        assert counted["counters"]["bad_message"] < GARBAGE + 100
        assert chain.state() == "inactive"
        browser.connection.send("x" * 100_000)
        until("too large a message ends its connection", browser.closed.is_set)
    with browsing(site):  # another page is served as before
        pass
    assert chain.state() == "inactive"


@pytest.mark.slow
def test_a_stop_is_taken_in_the_middle_of_a_flood(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        for _ in range(2000):
            browser.send(do="deactivate")
        browser.send(do="stop")
        assert browser.wait("stopped")["outcome"] == "confirmed"


def test_metrics_are_openmetrics_and_want_a_token(chain: Chain, site: Site) -> None:
    assert site.ask("GET", "/metrics")[0] == 401
    chain.client.set_prompt("HARD: go up x3")
    status, headers, body = site.ask("GET", "/metrics", {"Authorization": f"Bearer {METRICS}"})
    assert status == 200
    assert headers["content-type"].startswith("application/openmetrics-text")
    families = {
        family.name: family for family in parser.text_string_to_metric_families(body.decode())
    }
    alive = {s.labels["node"]: s.value for s in families["vla_zenoh_node_alive"].samples}
    assert alive["command"] == alive["sim"] == 1
    state = next(
        s.labels["vla_zenoh_node_state"]
        for s in families["vla_zenoh_node_state"].samples
        if s.labels["node"] == "command" and s.value == 1
    )
    assert state == "inactive"
    assert families["vla_zenoh_latency_seconds"].unit == "seconds"
    assert families["vla_zenoh_web_events"].type == "counter"
    assert len(body.splitlines()) < 3000


def test_settings_sent_at_once_are_made_in_their_order(chain: Chain, site: Site) -> None:
    with browsing(site) as browser:
        for percent in (90, 70, 80):
            browser.send(do="speed", percent=percent)
        browser.send(do="rate", hz=4)
        until("all are made", lambda: len(browser.answers("done")) == 4, READY_PATIENCE_S)

        def in_force() -> bool:
            task = chain.client.task
            return task is not None and (task.speed_percent, task.rate_hz) == (80, 4.0)

        chain.until("the last of them is in force", in_force)
        assert not browser.answers("rejected")
        assert browser.ask(do="speed", percent=100)["is"] == "done"
        assert browser.ask(do="rate", hz=5)["is"] == "done"


def test_a_page_that_floods_settings_is_told_that_they_wait(site: Site) -> None:
    with browsing(site) as browser:
        for _ in range(20):
            browser.send(do="speed", percent=100)
        until("one is rejected", lambda: browser.answers("rejected"))
        assert browser.answers("rejected")[0]["what"] == "busy"
        until("8 are made", lambda: len(browser.answers("done")) >= 8, READY_PATIENCE_S)
