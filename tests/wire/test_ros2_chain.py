"""``vla-zenoh up panda_ros2`` whole, with a kinematic robot in a bridge's and in rmw_zenoh's form.

What a real bridge and DDS add is tested in tests/ros2; here are the real processes of ours.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chain import Chain, running_chain
from ros2_peer import KinematicPanda, Ros2Peer
from ros2_rig import CAMERA, HEIGHT, WIDTH, write_profile
from vla_zenoh_ros2.keys import BOOL, EMPTY, TEXT

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import load_profile

pytestmark = pytest.mark.slow

STEPS, STEP_M = 10, 0.01
WAY_TOLERANCE_M = 0.0005
CAMERA_HZ = 30
DONE_S = 20.0
QUIET_S = 0.4
"""Longer than the guard follows a stream that has ended (timing.command_timeout_s)."""
SET_BOOL, TRIGGER = "std_srvs/srv/SetBool", "std_srvs/srv/Trigger"
REQUEST = "vla_msgs/srv/SetRequest"


@pytest.fixture(scope="module", params=["ros2dds", "rmw_zenoh"])
def lab(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Chain, KinematicPanda]]:
    folder = tmp_path_factory.mktemp("ros2chain")
    path = write_profile(folder, request.param, "  services: true\n")
    with (
        running_chain(folder, profile_file=path) as chain,
        open_session(load_profile(str(path)).session) as session,
    ):
        peer = Ros2Peer(session, request.param)
        robot = KinematicPanda(peer)
        stop = threading.Event()

        def film() -> None:
            noise = np.random.default_rng(0)
            while not stop.wait(1 / CAMERA_HZ):
                picture = peer.message(
                    "sensor_msgs/msg/Image",
                    header=peer.header(time.time_ns()),
                    height=HEIGHT,
                    width=WIDTH,
                    encoding="rgb8",
                    step=3 * WIDTH,
                    data=noise.integers(60, 200, 3 * WIDTH * HEIGHT, np.uint8),
                )
                peer.put(CAMERA, picture)

        thread = threading.Thread(target=film)
        thread.start()
        try:
            chain.activate_when_ready()
            yield chain, robot
        finally:
            stop.set()
            thread.join()
            robot.close()
            peer.close()


def test_ten_steps_asked_by_service_move_the_robot_by_ten_steps(
    lab: tuple[Chain, KinematicPanda],
) -> None:
    chain, robot = lab
    chain.client.set_prompt("hold")
    chain.until("it stands", lambda: chain.detail("at_rest"))
    began_m = robot.tcp_m
    answer = robot.peer.call(
        "/vla/set_request", REQUEST, prompt=f"HARD: go up x{STEPS}", rate_hz=10.0, active=True
    )
    assert answer.success, answer.message
    chain.until("the steps are done", lambda: chain.detail("policy_done"), DONE_S)
    chain.until("it stands", lambda: chain.detail("at_rest"))
    time.sleep(0.2)
    way_m = robot.tcp_m - began_m
    assert way_m == pytest.approx([0, 0, STEPS * STEP_M], abs=WAY_TOLERANCE_M)


def test_topics_do_what_services_do_and_their_answers_come_on_a_topic(
    lab: tuple[Chain, KinematicPanda],
) -> None:
    chain, robot = lab
    answers: list[dict[str, Any]] = []
    robot.peer.on("/vla/answer", TEXT, lambda message: answers.append(json.loads(message.data)))

    def ask(name: str, kind: str, **values: Any) -> dict[str, Any]:
        count = len(answers)
        robot.peer.put(f"/vla/{name}", robot.peer.message(kind, **values))
        chain.until(f"{name} is answered", lambda: len(answers) > count)
        return answers[-1]

    chain.client.deactivate()
    asked = {"id": "1", "prompt": "hold", "rate_hz": 5.0, "active": True}
    answer = ask("request", TEXT, data=json.dumps(asked))
    assert (answer["id"], answer["what"], answer["ok"]) == ("1", "request", True), answer
    assert ask("stop", EMPTY)["ok"]
    assert chain.state() == "stopped"
    refused = ask("active", BOOL, data=True)
    assert not refused["ok"]
    assert "stop" in refused["reason"]
    assert ask("reset", EMPTY)["ok"]
    for active in (True, False):
        answer = ask("active", BOOL, data=active)
        assert answer["ok"], answer
    assert ask("prompt", TEXT, data="go up")["reason"] == "prompt 'go up'"


def test_what_works_is_told_on_rosout(lab: tuple[Chain, KinematicPanda]) -> None:
    chain, robot = lab
    lines: list[Any] = []
    robot.peer.on("/rosout", "rcl_interfaces/msg/Log", lines.append)
    chain.until("it is told", lambda: lines)
    assert "/vla/stop" in lines[0].msg
    assert "offers services" in lines[0].msg


def test_stop_and_reset_by_service_are_those_of_our_keys(
    lab: tuple[Chain, KinematicPanda],
) -> None:
    chain, robot = lab
    answer = robot.peer.call("/vla/stop", TRIGGER)
    assert answer.success, answer.message
    assert chain.state() == "stopped"
    refused = robot.peer.call("/vla/set_active", SET_BOOL, data=True)
    assert not refused.success
    assert robot.peer.call("/vla/reset", TRIGGER).success
    chain.until("it is reset", lambda: chain.state() == "inactive")
    answer = robot.peer.call("/vla/set_active", SET_BOOL, data=True)
    assert answer.success, answer.message
    answer = robot.peer.call("/vla/set_active", SET_BOOL, data=False)
    assert answer.success, answer.message

    def quiet() -> bool:
        count = len(robot.goals)
        time.sleep(QUIET_S)
        return len(robot.goals) == count

    chain.until("an inactive arm is sent nothing", quiet)
