"""physicalai 0.3.0 with every node of ours: its owner is the arm, or its client the policy."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any, Self

import numpy as np
import pytest
from camera_rig import free_endpoint
from chain import CHAIN_PATIENCE_S, Chain, running_chain, write_profile
from physicalai_rig import Client, Owner

from vla_zenoh.lab.demo.scripted_motions import STEP_M

OWNED = """
extends: widowx_ai
robot: {{name: owned, driver: physicalai}}
trossen: null
physicalai: {{name: {name}, units: degrees, gripper_shut: 0.0, gripper_open: 0.044}}
task: {{prompt: hold, rate_hz: 10, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing:
  command_hz: 50
  state_hz: 50
  command_timeout_s: {patience_s[command]}
  state_timeout_s: {patience_s[state]}
hosts: {{here: {{nodes: [router, arm, command, worker]}}}}
"""
DRIVEN = """\
workers: [physicalai_client]
options: {{physicalai_client: {{profile: so101_sim, name: {name}, units: normalised}}}}
task: {{worker: physicalai_client}}
"""
NAME, OURS = "rival", "ours"
STEPS, REACHED_M = 5, 1e-3
STANDS_DEG, STANDS_S, LATEST_S, AGAIN_S = 0.05, 0.5, 8.0, 40.0
REACTION_S = 1.5
PACE_S, STEP, WAY, NEAR, EXACT = 0.05, 1.0, 20.0, 0.5, 0.2
"""Of a client's actions; the last four in hundredths of half a joint's range."""

pytestmark = pytest.mark.timeout(170)


class Watch(Client):
    """Their client, which reads where the arm is all the time, and acts if it is told."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.names = self.attached()
        self.rows: list[tuple[float, np.ndarray]] = []
        self.action: list[float] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            asked = {} if self.action is None else {"act": self.action}
            try:
                seen = self.ask(**asked)["positions"]
            except (AssertionError, OSError, ValueError):
                return  # it was killed
            self.rows.append((time.monotonic(), np.array(seen)))
            time.sleep(PACE_S / 2)

    def at(self) -> np.ndarray:
        """Where the arm is."""
        return self.rows[-1][1]

    def stood(self, since_s: float) -> tuple[float, float]:
        """After which time from `since_s` on the arm stands, and how far a joint went on."""
        end_s = time.monotonic() + LATEST_S
        while time.monotonic() < end_s:
            time.sleep(0.1)
            rows = [row for row in self.rows if row[0] >= since_s]
            if not rows:
                continue
            apart = np.array([np.abs(at - rows[-1][1]).max() for _, at in rows])
            moving = np.flatnonzero(apart > STANDS_DEG)
            stands_s = rows[moving[-1]][0] if len(moving) else since_s
            if rows[-1][0] - stands_s > STANDS_S:
                return stands_s - since_s, float(apart[0])
        raise AssertionError("it went on and on")

    def __exit__(self, *given: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        super().__exit__(*given)

    def __enter__(self) -> Self:
        return self


# -- its owner is the arm ---------------------------------------------------------------------
@pytest.fixture(scope="module")
def owners() -> Iterator[list[Owner]]:
    found = [Owner(NAME, "WidowX")]
    yield found
    found[-1].__exit__()


@pytest.fixture(scope="module")
def running(owners: list[Owner], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("owned")
    path = folder / "owned.yaml"
    path.write_text(OWNED.format(name=NAME, endpoint=free_endpoint(), patience_s=CHAIN_PATIENCE_S))
    assert owners
    with running_chain(folder, profile_file=path) as chain:
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        yield chain


@pytest.fixture
def chain(running: Chain) -> Chain:
    running.until("the arm is up", lambda: running.state("arm") in ("running", "fault"), AGAIN_S)
    running.settle()
    return running


def in_motion(chain: Chain) -> float:
    """Move the arm away from its nearer end; the time."""
    chain.client.set_prompt("HARD: go up" if chain.height_m() < 0.25 else "HARD: go down")
    chain.activate_when_ready()
    chain.until("the arm moves", chain.moves)
    return time.monotonic()


def test_a_prompt_moves_its_robot_by_what_was_asked_for(chain: Chain) -> None:
    chain.activate_when_ready()
    for prompt, sign in (("up", 1), ("down", -1)):
        before_m = chain.height_m()
        chain.client.set_prompt("hold")
        chain.client.set_prompt(f"HARD: go {prompt} x{STEPS}")
        chain.until(
            "the steps are carried out",
            lambda: chain.detail("policy_done") and chain.detail("accepted_steps") >= STEPS,
            AGAIN_S,
        )
        chain.wait_still()
        off_m = chain.height_m() - before_m - sign * STEPS * STEP_M
        print(f"{prompt}: {1e3 * off_m:.3f} mm off at rest")
        assert abs(off_m) < REACHED_M


def test_its_client_in_motion_is_a_fault_and_the_arm_brakes(chain: Chain) -> None:
    with Watch(NAME) as watch:
        in_motion(chain)
        watch.action = watch.at().tolist()
        since_s = time.monotonic()
        chain.until("the fault is told", lambda: chain.detail("fault", "arm"))
        print(f"a second commander: told after {time.monotonic() - since_s:.2f} s")
        watch.action = None
        assert "somebody else puts actions" in chain.detail("fault", "arm")
        print(f"and the arm stands after {watch.stood(since_s)} (s, degrees)")
        assert chain.state() != "active"


@pytest.mark.parametrize("node", ["arm", "command", "router"])
def test_a_node_of_ours_killed_leaves_its_robot_standing(chain: Chain, node: str) -> None:
    with Watch(NAME) as watch:
        in_motion(chain)
        killed = chain.pid(node)
        since_s = time.monotonic()
        os.kill(killed, signal.SIGKILL)
        took_s, further_deg = watch.stood(since_s)
        print(f"kill -9 of {node}: stands after {took_s:.2f} s, {further_deg:.2f} degrees on")
        assert took_s < REACTION_S
    pids: Any = chain.host.supervisor.pids
    chain.until("it runs again", lambda: pids().get(node) not in (None, killed), AGAIN_S)


def test_its_owner_killed_or_silent_ends_the_activation(chain: Chain, owners: list[Owner]) -> None:
    in_motion(chain)
    os.kill(owners[-1].pid, signal.SIGSTOP)
    since_s = time.monotonic()
    chain.until("nobody obeys", lambda: chain.state() != "active")
    print(f"owner silent: not active after {time.monotonic() - since_s:.2f} s")
    os.kill(owners[-1].pid, signal.SIGCONT)
    chain.until("the arm is up", lambda: chain.state("arm") in ("running", "fault"), AGAIN_S)
    chain.settle()
    in_motion(chain)
    owners[-1].kill()
    since_s = time.monotonic()
    chain.until("nobody obeys", lambda: chain.state() != "active")
    print(f"kill -9 of the owner: not active after {time.monotonic() - since_s:.2f} s")
    owners.append(Owner(NAME, "WidowX"))
    chain.until("the arm is up", lambda: chain.state("arm") == "running", AGAIN_S)


# -- its client is the policy -----------------------------------------------------------------
@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("driven")
    path = write_profile(folder, extends="so101_sim", more=DRIVEN.format(name=OURS))
    path.write_text(path.read_text().replace("worker: scripted", "worker: physicalai_client"))
    path.write_text(path.read_text().replace("task: {worker: physicalai_client}\n", ""))
    with running_chain(folder, profile_file=path) as chain:
        yield chain


@pytest.fixture
def client(driven: Chain) -> Iterator[Watch]:
    driven.until("the worker is up", lambda: "worker-physicalai_client" in driven.client.alive)
    with Watch(OURS) as watch:
        yield watch
    driven.client.deactivate()


def act(driven: Chain, client: Watch) -> list[float]:
    """Obey the client, which holds the arm where it is; what it sends."""
    driven.until("the arm is seen", lambda: client.rows)
    at = client.at().tolist()
    client.action = list(at)
    if driven.state() in ("fault", "stopped"):
        driven.client.reset()
    driven.activate_when_ready()
    return at


def turn(client: Watch, action: list[float], way: float) -> None:
    """Turn the first joint."""
    for _ in range(round(abs(way) / STEP)):
        action[0] += np.sign(way) * STEP
        client.action = list(action)
        time.sleep(PACE_S)


def driven_in_motion(driven: Chain, client: Watch) -> None:
    action = act(driven, client)
    turn(client, action, -WAY / 2 if action[0] > 0 else WAY / 2)
    threading.Thread(
        target=turn, args=(client, action, -3 * WAY if action[0] > 0 else 3 * WAY), daemon=True
    ).start()
    time.sleep(0.5)


def test_its_client_moves_our_arm_to_where_it_says(driven: Chain, client: Watch) -> None:
    action = act(driven, client)
    turn(client, action, -WAY if action[0] > 0 else WAY)
    driven.until("it is there", lambda: np.abs(client.at() - action)[:5].max() < NEAR, AGAIN_S)
    time.sleep(1.0)
    off = np.abs(client.at() - action)[:5].max()
    print(f"at rest {off:.4f} hundredths of half its range off")
    assert off < EXACT
    assert driven.state() == "active"


def test_its_client_killed_brakes_our_arm(driven: Chain, client: Watch) -> None:
    driven_in_motion(driven, client)
    since_ns, since_s = time.time_ns(), time.monotonic()
    client.kill()
    driven.until("nobody obeys", lambda: driven.state() != "active")
    print(f"kill -9 of their client: not active after {time.monotonic() - since_s:.2f} s")
    driven.wait_still()
    print(f"and stands after {driven.recorder.track().time_to_stand_s(since_ns):.2f} s")


def test_a_second_client_of_theirs_moves_it_under_our_limits(driven: Chain, client: Watch) -> None:
    action = act(driven, client)
    with Watch(OURS) as second:
        far = list(action)
        far[0] += WAY / 2 if action[0] < 0 else -WAY / 2
        second.action = far
        time.sleep(2.0)
        print(f"two clients: {driven.state()}, joint at {client.at()[0]:.1f} of {action[0]:.1f}")
        assert driven.state() in ("active", "inactive")
        low, high = sorted((action[0], far[0]))
        assert low - NEAR <= client.at()[0] <= high + NEAR


@pytest.mark.parametrize("node", ["worker-physicalai_client", "router"])
def test_a_node_of_ours_killed_brakes_our_arm(driven: Chain, client: Watch, node: str) -> None:
    driven_in_motion(driven, client)
    killed = driven.pid(node)
    since_ns = time.time_ns()
    os.kill(killed, signal.SIGKILL)
    pids: Any = driven.host.supervisor.pids
    driven.until("it runs again", lambda: pids().get(node) not in (None, killed), AGAIN_S)
    driven.until("nobody obeys", lambda: driven.state() != "active", AGAIN_S)
    driven.wait_still(AGAIN_S)
    if node == "router":  # without it nobody here sees the arm
        print(f"kill -9 of {node}: found at rest when states come again")
        return
    track = driven.recorder.track()
    print(f"kill -9 of {node}: stands after {track.time_to_stand_s(since_ns):.2f} s")
