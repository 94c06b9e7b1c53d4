"""The page of a robot of two arms: both are drawn, both stand after a stop, one moves by hand."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from camera_rig import free_endpoint, until
from web_rig import Browser, Site, browsing, serving, write_people

from vla_zenoh.errors import SessionError
from vla_zenoh.profile import load_profile
from vla_zenoh.runtime.launch import Host

pytest.importorskip("starlette", reason="needs vla-zenoh-web")
pytest.importorskip("uvicorn", reason="needs vla-zenoh-web")

READY_S, PATIENCE_S = 90.0, 20.0
POLL_S = 0.05
HIGH_M = 0.5
"""The height from which an arm goes down."""
PROFILE = """\
extends: two_pandas_sim
cameras:
  top: {{source: "sim:top", width: 160, height: 120, rate_hz: 5}}
  front: null
  left_wrist: null
  right_wrist: null
session:
  listen: [{endpoint}]
  connect: [{endpoint}]
timing: {{command_timeout_s: 0.5, state_timeout_s: 0.5, command_hz: 50, state_hz: 50}}
"""


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Host, Site]]:
    folder: Path = tmp_path_factory.mktemp("pair")
    file = folder / "pair.yaml"
    file.write_text(PROFILE.format(endpoint=free_endpoint()))
    over = threading.Event()
    with Host(load_profile(str(file)), None, log=lambda *_: None, tell=lambda *_: None) as host:

        def poll() -> None:
            while not over.wait(POLL_S):
                host.poll()

        thread = threading.Thread(target=poll)
        thread.start()
        try:
            assert host.client is not None
            alive = host.client
            until("a worker", lambda: "worker-scripted_pair" in alive.alive, READY_S)
            with serving(file, write_people(folder)) as site:
                yield host, site
        finally:
            over.set()
            thread.join()


@pytest.fixture(autouse=True)
def _no_latch(pair: tuple[Host, Site]) -> None:
    """A stop that a test has left latched would be in the way when it is tried again."""
    client = pair[0].client
    assert client is not None
    if client.latch_reason():
        client.reset()
        until("it is reset", client.cleared, READY_S)


def moves(page: Browser) -> bool:
    arms = page.state.get("arms", {})
    return all(arms[part].get("speed_m_s", 0) > 0.01 for part in ("left", "right"))


def activate(host: Host, page: Browser) -> None:
    client = host.client
    assert client is not None

    def tried() -> bool:
        try:
            client.activate()
        except SessionError:
            return False
        return True

    until("it is active", tried, READY_S)
    until("both arms move", lambda: moves(page), PATIENCE_S)


def test_both_arms_are_drawn_where_they_stand(pair: tuple[Host, Site]) -> None:
    with browsing(pair[1]) as page:
        around = page.answers("welcome")[0]["surroundings"]
        assert around["left"]["base"][:3] == [0.0, 0.0, 0.0]
        assert around["right"]["base"] == pytest.approx([1.2, 0.0, 0.0, 3.14159], abs=1e-4)
        activate(pair[0], page)
        until("chunks", lambda: all(arm.get("chunk_m") for arm in page.state["arms"].values()))
        for part in ("left", "right"):
            arm = page.state["arms"][part]
            assert len(arm["links_m"]) == 9
            assert arm["links_m"][-1] == pytest.approx(arm["measured_m"], abs=0.02)
            assert {"width_m", "command_m"} <= arm.keys()
            # A chunk begins near the arm of its own columns.
            assert arm["chunk_m"][0] == pytest.approx(arm["measured_m"], abs=0.1)


def test_a_stop_is_told_when_both_arms_stand(pair: tuple[Host, Site]) -> None:
    with browsing(pair[1]) as page:
        if not moves(page):
            activate(pair[0], page)
        page.send(do="stop")
        report = page.wait("stopped")
        assert report["outcome"] == "confirmed"
        assert report["stands_s"] is not None
        speeds = [arm["speed_m_s"] for arm in page.state["arms"].values()]
        assert len(speeds) == 2
        until("both stand", lambda: not moves(page))
        assert page.ask(do="reset")["is"] == "done"


def test_the_chosen_arm_is_moved_by_hand_and_the_other_stands(pair: tuple[Host, Site]) -> None:
    client = pair[0].client
    assert client is not None
    with browsing(pair[1]) as page:
        client.deactivate()
        for part, other in (("left", "right"), ("right", "left")):
            answer = page.ask(do="jog", on=True, frame="base", level=2, part=part)
            assert answer["is"] == "done", answer
            until("the page has the arm", lambda: page.state["jog"], PATIENCE_S)
            until("both stand", lambda: all_slower(page), PATIENCE_S)
            began = {name: arm["measured_m"] for name, arm in page.state["arms"].items()}
            # A high arm goes down: it would soon be straight.
            up = 1.0 if began[part][2] < HIGH_M else -1.0
            page.twist = [0.0, 0.0, up, 0.0, 0.0, 0.0]
            page.hold_until(
                "it goes up or down",
                lambda p=part, b=began, way=up: way * (height(page, p) - b[p][2]) > 0.03,
                READY_S,
            )
            page.let_go()
            until("both stand", lambda: all_slower(page), PATIENCE_S)
            assert page.state["arms"][other]["measured_m"] == pytest.approx(began[other], abs=3e-3)
        assert page.ask(do="jog", on=False, frame="base", level=2, part="left")["is"] == "done"


def test_an_arm_that_the_robot_lacks_is_named(pair: tuple[Host, Site]) -> None:
    with browsing(pair[1]) as page:
        answer = page.ask(do="jog", on=True, frame="base", level=1, part="middle")
        assert answer["is"] == "failed"
        assert answer["why"] == "the robot has no part 'middle'; it has left, right"


def height(page: Browser, part: str) -> float:
    return float(page.state["arms"][part]["measured_m"][2])


def all_slower(page: Browser) -> bool:
    return all(arm.get("speed_m_s", 1.0) < 0.003 for arm in page.state["arms"].values())
