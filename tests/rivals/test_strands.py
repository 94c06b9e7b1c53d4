"""strands-robots 0.5.3 itself: its mesh, with our simulated arm as one of its peers."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chain import LONG_PATIENCE_S, Chain, running_chain
from strands_rig import PROVIDER, OurPeer, StrandsPeer

ARM, BOSS, RIVAL = "panda", "boss", "rival"
TRUSTING = ("--obey", BOSS, "--obey", RIVAL, "--unsigned")
UP, STEP_M = 10, 0.01
EXACT_M = 1e-3
REACTION_S = 1.5
"""Of a stop on a busy computer."""

pytestmark = pytest.mark.timeout(170)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with running_chain(tmp_path_factory.mktemp("strands"), patience_s=LONG_PATIENCE_S) as found:
        found.activate_when_ready()
        found.settle()
        yield found


class Bench:
    """The mesh: our arm, and peers of theirs, which stay: each takes seconds to start."""

    def __init__(self, chain: Chain, folder: Path) -> None:
        self.chain, self.folder = chain, folder
        (self.endpoint,) = chain.profile.session.connect
        self.peers: dict[str, StrandsPeer] = {}
        self.ours = self.new_ours(*TRUSTING)

    def new_ours(self, *words: str) -> OurPeer:
        log = self.folder / f"ours-{time.monotonic_ns()}.log"
        return OurPeer(log, self.chain.profile_file, *words)

    def join(self, name: str) -> StrandsPeer:
        if name not in self.peers:
            self.peers[name] = StrandsPeer(name, self.endpoint, self.folder)
        peer = self.peers[name]
        self.chain.until(f"{name} sees our arm", lambda: ARM in peer.ask("peers"), 20)
        return peer

    def kill(self, name: str) -> None:
        self.peers.pop(name).kill()

    def heard(self, peer: StrandsPeer) -> None:
        """Wait until our side has heard of it."""

        def answer() -> bool:
            return "unheard" not in str(self.start(peer, "hold", 0.2))

        self.chain.until(f"{peer.name} is heard", answer, 20)
        self.chain.until("its order is over", lambda: self.chain.state() == "inactive", 10)

    def start(self, peer: StrandsPeer, instruction: str, duration: float = 20.0) -> Any:
        command = {"action": "start", "instruction": instruction, "duration": duration}
        return peer.ask("send", peer=ARM, command={**command, "policy_provider": PROVIDER})

    def moves(self, peer: StrandsPeer) -> None:
        """An endless motion, by an order of this peer."""
        chain = self.chain
        middle_m = 0.42
        prompt = "HARD: go up" if chain.height_m() < middle_m else "HARD: go down"

        def started() -> bool:  # as soon as its order before is over, see `heard`
            found = self.start(peer, prompt)
            return found.get("result", found)["reason"] == "started"

        chain.until("its order starts", started, 10)
        chain.until("it moves", chain.moves)

    def seconds_until(self, what: str, ask: Callable[[], Any]) -> float:
        began_s = time.monotonic()
        self.chain.until(what, ask, 20)
        return time.monotonic() - began_s

    def still(self) -> bool:
        return self.chain.state() in ("inactive", "stopped") and bool(self.chain.detail("at_rest"))

    def close(self) -> None:
        for peer in self.peers.values():
            peer.kill()
        self.ours.__exit__()


@pytest.fixture(scope="module")
def mesh(chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    found = Bench(chain, tmp_path_factory.mktemp("mesh"))
    yield found
    found.close()


@pytest.fixture
def bench(mesh: Bench) -> Iterator[Bench]:
    yield mesh
    mesh.chain.settle()


def test_their_peers_see_our_arm_and_its_joints(bench: Bench) -> None:
    peer = bench.join("viewer")
    said = peer.ask("peers")[ARM]
    assert said["hw"] == bench.chain.profile.robot.name
    assert said["task_status"] == "idle"
    assert said["connected"] is True
    key = f"strands/{ARM}/state"
    peer.ask("watch", key=key)
    bench.chain.until("a state came", lambda: peer.ask("newest", key=key), 10)
    joints = peer.ask("newest", key=key)["joints"]
    assert list(joints) == list(bench.chain.profile.robot.arm_joints)
    assert peer.ask("ping", peer=ARM)["status"] == "ok"


def test_an_order_ends_where_it_says(bench: Bench) -> None:
    boss, chain = bench.join(BOSS), bench.chain
    bench.heard(boss)
    chain.wait_still()
    before_m = chain.height_m()
    order = {"instruction": f"HARD: go up x{UP}", "duration": 4.0, "policy_provider": PROVIDER}
    found = boss.ask("tell", peer=ARM, **order)
    assert found["result"]["reason"] == "completed"
    chain.wait_still()
    off_m = chain.height_m() - before_m - UP * STEP_M
    print(f"at rest {off_m * 1e3:.2f} mm off after {UP * STEP_M:g} m")
    assert abs(off_m) < EXACT_M


def test_their_agents_tool_sees_it_and_moves_it(bench: Bench) -> None:
    boss = bench.join(BOSS)
    bench.heard(boss)
    told = {"action": "tell", "target": ARM, "instruction": "hold", "duration": 0.5}
    assert ARM in str(boss.ask("tool", action="peers"))
    assert "completed" in str(boss.ask("tool", **told, policy_provider=PROVIDER))
    assert "stands" not in str(boss.ask("tool", action="stop", target=ARM))


def test_somebody_who_was_not_named_moves_nothing_and_is_told_why(bench: Bench) -> None:
    viewer = bench.join("viewer")
    found = bench.start(viewer, "HARD: go up")
    assert found["type"] == "error"
    assert found["reason"] == "not_obeyed"
    assert bench.chain.state() == "inactive"


def test_a_second_commander_is_refused_while_the_first_is_obeyed(bench: Bench) -> None:
    boss, rival = bench.join(BOSS), bench.join(RIVAL)
    bench.heard(boss)
    bench.heard(rival)
    bench.moves(boss)
    found = bench.start(rival, "hold")
    assert found["reason"] == "busy"
    assert BOSS in found["error"]
    assert bench.chain.state() == "active"


def test_a_stop_of_ours_locks_their_peers_and_stops_their_robots(bench: Bench) -> None:
    peer = bench.join("viewer")
    bench.chain.client.stop()
    took_s = bench.seconds_until("theirs is locked", lambda: peer.ask("stopped")["locked"])
    bench.chain.until("their robot is stopped", lambda: peer.ask("stopped")["stops"] == 1, 5)
    print(f"our stop: their peer is locked after {took_s:.2f} s")
    assert took_s < REACTION_S


def test_anybody_may_brake_it_without_a_latch(bench: Bench) -> None:
    boss, viewer = bench.join(BOSS), bench.join("viewer")
    bench.heard(boss)
    bench.moves(boss)
    found = viewer.ask("send", peer=ARM, command={"action": "stop"})
    assert found["result"]["ok"] is True
    bench.chain.until("it stands here, too", bench.still, 2)
    assert bench.chain.state() == "inactive"


def test_an_emergency_stop_of_anybody_latches_and_nobody_there_resets_it(bench: Bench) -> None:
    boss, viewer = bench.join(BOSS), bench.join("viewer")
    bench.heard(boss)
    bench.moves(boss)
    began = viewer.begin("estop")  # theirs brakes first, and after 3 s publishes the stop
    braked_s = bench.seconds_until("it stands", bench.still)
    answers = began.result(20)
    assert ARM in {one["responder_id"] for one in answers}
    latched_s = bench.seconds_until("it is latched", lambda: bench.chain.state() == "stopped")
    print(f"their emergency_stop: stood after {braked_s:.2f} s, latched {latched_s:.2f} s later")
    assert bench.start(boss, "hold")["reason"] == "stopped"
    for action in ("resume", "reset"):
        found = boss.ask("send", peer=ARM, command={"action": action})
        assert "never_reset" in str(found) or "validation" in str(found)
    assert bench.chain.state() == "stopped"


def test_a_bare_stop_on_the_key_latches_in_motion(bench: Bench) -> None:
    boss, viewer = bench.join(BOSS), bench.join("viewer")
    bench.heard(boss)
    bench.moves(boss)
    viewer.begin("publish", key="strands/safety/estop", body={"nonsense": True})
    took_s = bench.seconds_until(
        "it stands and is latched", lambda: bench.chain.state() == "stopped" and bench.still()
    )
    print(f"strands/safety/estop: latched and at rest after {took_s:.2f} s")
    assert took_s < REACTION_S


def test_a_commander_killed_in_motion_brakes_the_arm(bench: Bench) -> None:
    boss = bench.join(BOSS)
    bench.heard(boss)
    bench.moves(boss)
    bench.kill(BOSS)
    took_s = bench.seconds_until("it stands", bench.still)
    print(f"kill -9 of the commander: stood after {took_s:.2f} s")
    assert took_s < 2.0 + 0.5 + REACTION_S
    bench.ours.until("silent")


def test_our_peer_killed_in_motion_brakes_the_arm(bench: Bench) -> None:
    boss = bench.join(BOSS)
    bench.heard(boss)
    bench.moves(boss)
    bench.ours.kill()
    took_s = bench.seconds_until("it stands", bench.still)
    print(f"kill -9 of serve strands: stood after {took_s:.2f} s")
    assert took_s < REACTION_S
    bench.ours = bench.new_ours(*TRUSTING)
    bench.heard(boss)


def test_a_router_killed_in_motion_brakes_the_arm(bench: Bench) -> None:
    boss, chain = bench.join(BOSS), bench.chain
    bench.heard(boss)
    bench.moves(boss)
    before = chain.pid("router")
    os.kill(before, signal.SIGKILL)
    chain.until("a new router", lambda: chain.host.supervisor.pids().get("router") != before, 10)
    took_s = bench.seconds_until("it stands", bench.still)
    print(f"kill -9 of the router: found standing {took_s:.2f} s after a new one was started")
    again_s = bench.seconds_until(
        "theirs sees ours", lambda: boss.ask("ping", peer=ARM)["status"] == "ok"
    )
    print(f"their peer reaches ours {again_s:.2f} s later")
    bench.heard(boss)
