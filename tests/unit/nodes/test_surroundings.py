"""What the command node believes of what others say: of themselves, and of nobody else."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from camera_rig import PATIENCE_S, await_match, free_endpoint, until
from command_rig import model_spec

from vla_zenoh.bus import clock as offsets
from vla_zenoh.bus.clock import MAX_HEARD, MAX_PEERS
from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.keys import ON_BEHALF, STARTING, Kind
from vla_zenoh.nodes.command import inputs
from vla_zenoh.nodes.command.inputs import MAX_WORKERS, CommandInputs, PeerMonitor
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, Header, NodeStatus, Stamped

ROOM_S = 0.3
"""How long a made-up name keeps its place in this test."""
AGE_TOLERANCE_S = 5.0
AT_ONCE = 4


class Scene:
    """The command node's ears, a camera node, and a worker that lies in its role."""

    def __init__(self, command: Node, camera: Node, thief: Node) -> None:
        self.command, self.camera, self.thief = command, camera, thief
        self.ears = PeerMonitor(command)
        self.peers = PeerSnapshot()
        self.nodes: tuple[Node, ...] = (command, camera, thief)
        for node in (camera, thief):
            await_match(node.session, node.keys.status(node.name))
        until("both are alive", lambda: {camera.name, thief.name} <= self.look().alive)

    def look(self) -> PeerSnapshot:
        self.command.clocks.poll()
        now_ns = self.command.clock.wall_ns()
        self.ears.read_news(now_ns)
        self.peers = self.ears.snapshot(now_ns) or self.peers
        return self.peers

    def says(self, node: Node, age_s: Any) -> None:
        """A status of `node` that tells of the front camera, and is heard."""
        count = self.command.counters["refused.foreign_camera"]
        node.publish_status("running", detail={"cameras": {"front": {"age_s": age_s}}}, now=True)
        if node is self.thief:
            until(
                "it is refused",
                lambda: self.look() and self.command.counters["refused.foreign_camera"] > count,
            )

    def refused(self, reason: str) -> int:
        return self.command.counters[f"refused.{reason}"]


@pytest.fixture
def scene() -> Iterator[Scene]:
    with made() as found:
        yield found


@contextmanager
def made() -> Iterator[Scene]:
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim"), {"session": {"listen": [endpoint], "connect": [endpoint]}}
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as here,
        open_session(profile.session) as there,
        open_session(profile.session) as elsewhere,
    ):
        found = Scene(
            Node("command", profile, here),
            Node("camera", profile, there),
            Node("worker-scripted", profile, elsewhere),
        )
        yield found
        for node in found.nodes:
            node.close()


def test_a_camera_is_believed_by_the_node_that_serves_it_and_by_no_other(scene: Scene) -> None:
    scene.says(scene.thief, -1e9)
    assert scene.look().camera_nodes == {}
    assert scene.peers.camera_ages_s == {}

    scene.says(scene.camera, 3.0)
    until("the camera's own word", lambda: scene.look().camera_nodes == {"front": "camera"})
    assert 3.0 <= scene.peers.camera_ages_s["front"] < 3.0 + AGE_TOLERANCE_S

    scene.says(scene.thief, -1e9)
    assert scene.look().camera_nodes == {"front": "camera"}
    assert scene.peers.camera_ages_s["front"] >= 3.0


def test_of_a_camera_node_that_is_gone_no_image_is_known(scene: Scene) -> None:
    scene.says(scene.camera, 0.0)
    until("its word", lambda: scene.look().camera_ages_s)
    scene.nodes = (scene.command, scene.thief)
    scene.camera.close()
    until("it is gone", lambda: scene.camera.name not in scene.look().alive)
    assert scene.peers.camera_ages_s == {}


def test_what_is_wrong_with_a_camera_is_its_own_nodes_word_until_it_is_good(scene: Scene) -> None:
    def says(node: Node, bad: Any) -> None:
        fields = {"age_s": 0.0, **({} if bad is None else {"bad": bad})}
        node.publish_status("running", detail={"cameras": {"front": fields}}, now=True)

    says(scene.camera, {"why": "is black", "check": "clipped_share", "value": 1.0, "limit": 0.98})
    until("its word", lambda: scene.look().camera_faults == {"front": "is black"})
    count = scene.refused("foreign_camera")
    says(scene.thief, None)
    until("it is refused", lambda: scene.look() and scene.refused("foreign_camera") > count)
    assert scene.peers.camera_faults == {"front": "is black"}
    says(scene.camera, None)
    until("it is good", lambda: scene.look().camera_faults == {})
    for nonsense in (True, "black", {}, {"why": 3.0}):
        says(scene.camera, nonsense)
        says(scene.camera, {"why": "x" * 5000})
        until("cut short", lambda: scene.look().camera_faults.get("front") == "x" * 300)
        says(scene.camera, nonsense)
        until("good", lambda: not scene.look().camera_faults)


def test_a_worker_among_many_who_complain_says_when_it_is_well_again(scene: Scene) -> None:
    others = [
        Node(f"worker-{nth}", scene.thief.profile, scene.camera.session)
        for nth in range(MAX_WORKERS)
    ]
    workers = [scene.thief, *others]
    until("all live", lambda: {node.name for node in workers} <= scene.look().alive)

    def complain(node: Node, complaint: str) -> None:
        node.publish_status("running", detail={"complaint": complaint}, now=True)

    for node in workers[:-1]:  # one after the other: more at once find no room in a mailbox
        name = node.name.removeprefix("worker-")
        complain(node, "no sun")
        until(name, lambda name=name: scene.look().worker_complaints.get(name) == "no sun")
    complain(workers[-1], "no sun")
    until("it is counted", lambda: scene.look() and scene.refused("more_workers") == 1)

    complain(scene.thief, "no moon")
    until("its new word", lambda: scene.look().worker_complaints["scripted"] == "no moon")
    complain(scene.thief, "")
    until("it is well", lambda: "scripted" not in scene.look().worker_complaints)
    complain(workers[-1], "no sun")
    until("there is room", lambda: str(MAX_WORKERS - 1) in scene.look().worker_complaints)
    assert len(scene.peers.worker_complaints) == MAX_WORKERS
    for node in others:
        node.close()


def test_up_that_still_takes_a_living_node_for_a_starting_one_is_not_heard_in_its_place(
    scene: Scene,
) -> None:
    up = NodeStatus("camera", STARTING, "robot", 1, 1)
    header = records.encode_header(Header(time.time_ns(), 1, f"{ON_BEHALF}camera#1"))
    key = scene.camera.keys.status("camera")
    for _ in range(AT_ONCE):
        scene.camera.session.put(key, records.encode(up), attachment=header)
    scene.says(scene.camera, 3.0)
    until("the camera's own word", lambda: scene.look().camera_nodes == {"front": "camera"})
    assert scene.refused("foreign_status") == 0


def test_of_two_nodes_of_one_name_the_other_is_heard_when_one_has_fallen_silent(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = scene.camera
    says = {"cameras": {"front": {"age_s": 3.0}}}
    source, camera.source = camera.source, "camera#another"
    other = camera.declare_publisher(camera.keys.status("camera"), Kind.TELEMETRY)
    camera.source = source
    status = NodeStatus("camera", "running", "there", 1, 1, detail=says, boot="boot")
    scene.says(camera, 1.0)
    until("the camera is heard", lambda: scene.look().camera_nodes)
    other.publish(status)
    until("the other is rejected", lambda: scene.look() and scene.refused("foreign_status"))
    assert scene.look().hosts["camera"] != "there"
    monkeypatch.setattr(inputs, "SILENT_S", ROOM_S)
    time.sleep(ROOM_S)
    other.publish(status)
    until("the other is heard", lambda: scene.look().hosts["camera"] == "there")


def test_the_spec_of_a_worker_is_accepted_from_the_source_of_its_status(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, spec = scene.thief, model_spec("scripted")
    source, key = worker.source, worker.keys.spec("scripted")
    worker.source = "worker-scripted#another"
    other = worker.declare_publisher(key, Kind.TELEMETRY)
    worker.source = source
    own = worker.declare_publisher(key, Kind.TELEMETRY)

    def seen(by: str) -> bool:
        return scene.look().spec_sources.get("scripted") == by

    def says(publisher: Publisher, wanted: str) -> bool:
        publisher.publish(spec)
        return seen(wanted)

    await_match(worker.session, key)
    until("the other's spec is heard", lambda: says(other, "worker-scripted#another"))
    rejected = scene.refused("foreign_spec")
    own.publish(spec)
    until("it is foreign", lambda: scene.look() and scene.refused("foreign_spec") > rejected)
    worker.publish_status("inferring", now=True)
    until("the worker's own spec is heard", lambda: says(own, source))
    # Its status may be silent for long, and that is no other worker.
    monkeypatch.setattr(inputs, "SILENT_S", ROOM_S)
    time.sleep(2 * ROOM_S)
    worker.publish_status("inferring", now=True)
    for _ in range(AT_ONCE):
        scene.look()
        time.sleep(ROOM_S / AT_ONCE)
    assert seen(source)


def test_no_picture_is_younger_than_now(scene: Scene) -> None:
    for nth, age_s in enumerate([True, "0", None, -1e9], 1):
        scene.says(scene.camera, 7.0)
        until("an age", lambda: scene.look().camera_ages_s.get("front", 0.0) >= 7.0)
        scene.says(scene.camera, age_s)
        other = {"wrist": {"age_s": 100.0 * nth}}
        scene.camera.publish_status("running", detail={"cameras": other}, now=True)
        until(
            "all of it is heard",
            lambda nth=nth: scene.look().camera_ages_s.get("wrist", 0.0) >= 100.0 * nth,
        )
        assert scene.peers.camera_ages_s["front"] >= (0.0 if age_s == -1e9 else 7.0), age_s


def test_made_up_names_do_not_keep_out_a_clock_that_is_there(scene: Scene) -> None:
    status = records.encode(
        NodeStatus("worker-scripted", "running", "gpu", 1, 1, {}, {}, {}, {}, {})
    )
    key = scene.thief.keys.status("worker-scripted")
    scene.thief.publish_status("running", now=True)
    until("its own voice", lambda: scene.look().hosts.get("worker-scripted"))
    for number in range(2 * MAX_PEERS):
        header = records.encode_header(Header(time.time_ns(), number, f"ghost{number}#1"))
        scene.thief.session.put(key, status, attachment=header)
        if number % AT_ONCE == AT_ONCE - 1:  # more do not find room in a mailbox
            until(
                "they are heard",
                lambda all_=number + 1: scene.look() and scene.refused("foreign_status") >= all_,
            )
    late = Node("worker-late", scene.thief.profile, scene.thief.session)
    until("the clock of who comes late", lambda: "worker-late" in scene.look().clocks)
    late.close()


def test_a_reader_who_is_told_of_nobody_measures_who_lives_among_made_up_names(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(offsets, "HEARD_PATIENCE_S", ROOM_S)
    reader, number = scene.thief, 0
    for number in range(2 * MAX_HEARD):
        reader.clocks.to_local_clock(Header(0, 0, f"ghost{number}#1"), None)

    def measured() -> bool:
        nonlocal number
        number += 1
        reader.clocks.to_local_clock(Header(0, 0, f"ghost{number}#1"), None)
        reader.clocks.to_local_clock(Header(0, 0, scene.camera.source), None)
        reader.clocks.poll()
        return "camera" in reader.clocks.offsets()

    until("the camera's clock", measured)
    for number in range(2 * MAX_HEARD):
        reader.clocks.to_local_clock(Header(0, 0, f"stranger{number}#1"), None)
    assert "camera" in reader.clocks.offsets()


def test_a_deadman_and_a_node_that_were_gone_between_two_polls_are_gone_for_one(
    scene: Scene,
) -> None:
    session, keys = scene.thief.session, scene.command.keys
    witness = PeerMonitor(scene.command)

    def seen() -> PeerSnapshot | None:
        return witness.snapshot(scene.command.clock.wall_ns())

    declared = [keys.holding("pedal"), keys.alive("extra")]
    tokens = [session.liveliness().declare_token(key) for key in declared]
    until(
        "both are there", lambda: "pedal" in scene.look().holders and "extra" in scene.look().alive
    )
    for token in tokens:
        token.undeclare()
    until("both are gone", lambda: (now := seen()) and not {"pedal"} & now.holders)
    tokens = [session.liveliness().declare_token(key) for key in declared]
    until(
        "both are back", lambda: (now := seen()) and "pedal" in now.holders and "extra" in now.alive
    )
    first, second = scene.look(), scene.look()
    assert "pedal" not in first.holders
    assert "extra" not in first.alive
    assert "pedal" in second.holders
    assert "extra" in second.alive
    for token in tokens:
        token.undeclare()


def test_a_robot_that_is_back_is_heard_at_once_however_long_the_last_one_may_be_silent() -> None:
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim"), {"session": {"listen": [endpoint], "connect": [endpoint]}}
    )
    timing = profile.timing.model_copy(update={"state_timeout_s": 10 * PATIENCE_S})
    profile = profile.model_copy(update={"timing": timing})
    with open_session(profile.session, mode="router"), open_session(profile.session) as here:
        command = Node("command", profile, here)
        heard = CommandInputs(command)
        for width_m in (0.01, 0.02):  # of a robot that lives until it is heard
            with open_session(profile.session) as there:
                robot = Node("sim", profile, there)
                publisher = robot.declare_publisher(robot.keys.state_gripper, Kind.STATE)
                state = GripperState(width_m, moving=False, holding=False)

                def gripper(
                    publisher: Publisher = publisher, state: GripperState = state
                ) -> Stamped[GripperState] | None:
                    publisher.publish(state)
                    return heard.poll(command.clock.wall_ns()).gripper

                assert until("its state", gripper).record.width_m == width_m
        command.close()
