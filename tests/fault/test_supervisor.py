"""``vla-zenoh up`` as a process: how it ends, what it leaves behind, when it gives up."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from camera_rig import free_endpoint, until
from chain import MOVING_M_S, READY_PATIENCE_S, Recorder, write_profile

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client, StopOutcome
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import load_profile
from vla_zenoh.runtime.process import PARENT_VARIABLE
from vla_zenoh.runtime.supervisor import GIVE_UP_AFTER, NodeCommand, Supervisor, signal_group

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parents[2] / "examples"
END_S = 3.0
BUSY_S = 1.0
"""What a busy machine may add to it."""
STILL_TWIST = 1e-3
GIVE_UP_S = 90.0
"""Nine seconds of waiting between six starts of an interpreter."""
NODES = {"router", "sim", "camera", "command", "worker-scripted", "rolling"}


class Up:
    """A running ``vla-zenoh up`` and what it wrote."""

    def __init__(self, *arguments: str) -> None:
        environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
        environment["XDG_STATE_HOME"] = str(Path(arguments[0]).parent / "state")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh", "up", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            start_new_session=True,
        )
        self.lines: list[str] = []
        self.thread = threading.Thread(target=self._read)
        self.thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def end(self, number: int, timeout_s: float = 15.0) -> float:
        """Send it a signal; returns how long it took to end (s)."""
        began = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(timeout_s)
        return time.monotonic() - began

    def children(self) -> dict[int, str]:
        """Process number -> command line of all that it, or what it started, has started."""
        marked = f"{PARENT_VARIABLE}={self.process.pid}".encode()
        found: dict[int, str] = {}
        for folder in Path("/proc").iterdir():
            try:
                if not folder.name.isdigit():
                    continue
                if marked not in (folder / "environ").read_bytes().split(b"\0"):
                    continue
                if (folder / "stat").read_text().rpartition(") ")[2].startswith("Z"):
                    continue
                found[int(folder.name)] = (folder / "cmdline").read_bytes().decode()
            except OSError:  # it has just ended
                continue
        return found


@contextmanager
def up(*arguments: str) -> Iterator[Up]:
    running = Up(*arguments)
    try:
        yield running
    finally:
        if running.process.poll() is None:
            running.process.kill()
            running.process.wait()
        for pid in running.children():
            os.kill(pid, signal.SIGKILL)
        running.thread.join(5.0)
        assert running.process.stdout is not None
        running.process.stdout.close()


@contextmanager
def client_of(path: Path) -> Iterator[tuple[Client, Recorder]]:
    profile = load_profile(str(path))
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        yield Client(profile, session).subscribe(), Recorder(session, profile.keys)


def get_moving(client: Client, recorder: Recorder) -> None:
    # What is put before the command node listens is lost.
    until("the task is said", lambda: client.task is not None, READY_PATIENCE_S)

    def activated() -> bool:
        try:
            return client.activate().active
        except SessionError:
            return False

    until("an active arm", activated, READY_PATIENCE_S)
    client.set_prompt("HARD: go up")

    def moves() -> bool:
        state = recorder.newest_state()
        return state is not None and bool(np.linalg.norm(state.twist[:3]) > MOVING_M_S)

    until("a moving arm", moves)
    time.sleep(0.3)


def ends(running: Up, but: frozenset[int] = frozenset()) -> None:
    """All nodes have ended within the time, but those of `but`."""
    give_up = time.monotonic() + END_S + BUSY_S
    while set(running.children()) - but:
        if time.monotonic() > give_up:
            left = "\n".join(running.children().values()).replace("\0", " ")
            raise AssertionError(f"still there:\n{left}\n{running.text}")
        time.sleep(0.02)


def test_a_stop_outlives_up_until_it_is_reset_and_the_example_of_a_robot_moves(
    tmp_path: Path,
) -> None:
    path, endpoint = tmp_path / "lab.yaml", free_endpoint()
    of_the_arm = {"state": "arm#", "command": "command#"}
    path.write_text(
        f"extends: {EXAMPLES / 'python_robot.yaml'}\n"
        f"session: {{connect: [{endpoint}], listen: [{endpoint}]}}\n"
    )
    with up(str(path)) as first, client_of(path) as (client, recorder):
        recorder.only = of_the_arm
        get_moving(client, recorder)
        client.stop()
        until("it stands", lambda: client.stop_progress().outcome is StopOutcome.CONFIRMED)
        first.end(signal.SIGTERM)
    with up(str(path)), client_of(path) as (client, recorder):
        until("it is stopped", lambda: state_of(client) == "stopped", READY_PATIENCE_S)
        with pytest.raises(SessionError, match="stopped before this node was started"):
            client.activate()
        client.reset()
        recorder.only = of_the_arm
        get_moving(client, recorder)


def state_of(client: Client) -> str:
    status = client.status("command")
    return status.state if status is not None else ""


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
    ids=lambda n: n.name,
)
def test_a_signal_brakes_the_arm_first_and_then_ends_everything(
    tmp_path: Path, number: signal.Signals
) -> None:
    path = write_profile(tmp_path)
    with up(str(path)) as running, client_of(path) as (client, recorder):
        get_moving(client, recorder)
        assert len(running.children()) == len(NODES)
        took_s = running.end(number)
        assert running.process.returncode == 0, running.text
        print(f"{number.name}: ended in {took_s:.2f} s")
        assert took_s < END_S + BUSY_S
        assert running.children() == {}
        _, last = max(recorder.commands(), key=lambda pair: pair[0].seq)
        assert np.abs(last.twist).max() < STILL_TWIST
        state = recorder.newest_state()
        assert state is not None
        assert np.linalg.norm(state.twist[:3]) < MOVING_M_S
        running.thread.join(5.0)
        assert "braking the arm" in running.text
        assert "all nodes have stopped" in running.text


def test_nothing_outlives_a_killed_supervisor(tmp_path: Path) -> None:
    path = write_profile(tmp_path)
    with up(str(path)) as running, client_of(path) as (client, recorder):
        get_moving(client, recorder)
        hung = next(pid for pid, line in running.children().items() if "\0worker\0" in line)
        # Dead before it is told: it must not need to be told.
        os.kill(hung, signal.SIGSTOP)
        running.process.kill()
        killed = time.monotonic()
        ends(running, but=frozenset({hung}))
        print(f"killed supervisor: all ended in {time.monotonic() - killed:.2f} s")
        os.kill(hung, signal.SIGCONT)
        ends(running)


def test_a_killed_supervisor_that_nobody_has_buried_yet_counts_as_gone(tmp_path: Path) -> None:
    """Killed while its nodes still start up: they find a dead parent, and end."""
    path = write_profile(tmp_path)
    with up(str(path)) as running:
        until("nodes", lambda: len(running.children()) >= len(NODES), READY_PATIENCE_S)
        os.kill(running.process.pid, signal.SIGKILL)  # and no wait(): it stays a zombie
        ends(running)


def test_a_profile_that_cannot_run_starts_nothing(tmp_path: Path) -> None:
    with up(str(write_profile(tmp_path, more="robot: {tcp_frame: nobody}\n"))) as running:
        running.process.wait(READY_PATIENCE_S)
        running.thread.join(5.0)
        assert running.process.returncode == 1
        assert "robot: panda.urdf has no link 'nobody'" in running.text
        assert "nothing was started" in running.text
        assert "started (pid" not in running.text


ARM_WITHOUT_CABLE = """
class Arm:
    def __init__(self): raise RuntimeError("no cable")
    def read(self): ...
    def move(self, command): ...
"""
WITHOUT_CABLE = """
extends: small
robot: {driver: arm}
arm: {file: ./without_cable.py}
cameras: null
options: {scripted: {camera: ""}}
hosts: {here: {nodes: [router, arm, command, worker]}}
"""


@pytest.mark.slow
def test_a_node_that_dies_at_every_start_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "without_cable.py").write_text(ARM_WITHOUT_CABLE)
    write_profile(tmp_path)
    path = tmp_path / "arm.yaml"
    path.write_text(WITHOUT_CABLE)
    with up(str(path)) as running:
        began = time.monotonic()
        running.process.wait(GIVE_UP_S)
        running.thread.join(5.0)
        print(f"given up after {time.monotonic() - began:.1f} s")
        assert running.process.returncode == 1
        assert running.children() == {}
        assert f"crashed {GIVE_UP_AFTER} times in a row; giving up" in running.text
        assert "keeps crashing" in running.text
        assert "Arm cannot be made: RuntimeError: no cable" in running.text


DIES_IN_LOAD = """
import os
from vla_zenoh.policy import ActionSpec, ModelSpec

class Dies:
    spec = ModelSpec(name="dies", action=ActionSpec(horizon=1, dt_s=0.1))
    def load(self): os._exit(3)
    def infer(self, observation): ...
"""


@pytest.mark.slow
def test_a_worker_that_dies_at_every_start_leaves_the_robot_to_the_others(tmp_path: Path) -> None:
    (tmp_path / "dies.py").write_text(DIES_IN_LOAD)
    more = "workers: [scripted, dies]\nmodels: {dies: ./dies.py}\n"
    path = write_profile(tmp_path, more=more)
    with up(str(path)) as running, client_of(path) as (client, recorder):
        said = f"crashed {GIVE_UP_AFTER} times in a row; not restarting it"
        until("it is left alone", lambda: said in running.text, GIVE_UP_S)
        assert len(running.children()) == len(NODES)
        get_moving(client, recorder)


def test_a_router_that_runs_already_is_used_and_left_running(tmp_path: Path) -> None:
    path = write_profile(tmp_path)
    profile = load_profile(str(path))
    with (
        open_session(profile.session, mode="router"),
        up(str(path)) as running,
        client_of(path) as (client, _),
    ):
        until("a sim", lambda: "sim" in client.alive, READY_PATIENCE_S)
        until("the others", lambda: len(running.children()) == len(NODES) - 1)
        (where,) = profile.session.connect
        assert f"one answers already at {where}; using it, until its program ends" in running.text
        assert "--connect and --listen, another port" in running.text
        took_s = running.end(signal.SIGTERM)
        assert took_s < END_S + BUSY_S
        assert running.children() == {}
        open_session(profile.session).close()


def test_with_json_every_line_is_an_object_that_says_when_and_which_node(tmp_path: Path) -> None:
    path = write_profile(tmp_path, more="hosts: {here: {nodes: [router]}}\n")
    with up(str(path), "--json", "--log-dir", str(tmp_path)) as running:
        until("the router", lambda: "routing, small" in running.text, READY_PATIENCE_S)
        until("all is told", lambda: "watch: " in running.text, READY_PATIENCE_S)
        running.end(signal.SIGTERM)
        running.thread.join(5.0)
    told = [json.loads(line) for line in running.lines]
    assert all(set(each) == {"time_s", "node", "from", "text"} for each in told)
    assert {each["node"] for each in told} == {"up", "router"}
    assert all(abs(each["time_s"] - time.time()) < READY_PATIENCE_S for each in told)
    assert told[-1]["text"] == "all nodes have stopped"


MODEL = """
import subprocess, sys

INNER = '''
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("inner", flush=True)
time.sleep(60)
'''

class Model:
    def __init__(self):
        subprocess.run([sys.executable, "-c", INNER])

    def infer(self, observation):
        pass
"""


def test_what_a_node_has_started_ends_with_it(tmp_path: Path) -> None:
    """A model's own environment is made by a process between the supervisor and the node."""
    model = tmp_path / "slow_to_make.py"
    model.write_text(MODEL)
    lines: list[str] = []
    supervisor = Supervisor(
        [NodeCommand("worker-slow", "worker", ("worker", str(model)))],
        log=lambda _, line: lines.append(line),
        tell=lambda *_: None,
    )
    supervisor.start()
    try:
        until("a process that the model has started", lambda: "inner" in lines, READY_PATIENCE_S)
        (group,) = supervisor.pids().values()
        assert os.getpgid(group) == group
    finally:
        supervisor.stop(time.monotonic() + END_S)

    until("nothing is left of it", lambda: not group_runs(group))


def begin(*commands: NodeCommand) -> tuple[Supervisor, list[str]]:
    told: list[str] = []
    supervisor = Supervisor(
        commands, log=lambda *_: None, tell=lambda name, said: told.append(f"{name} {said}")
    )
    supervisor.start()
    return supervisor, told


def broken(name: str, kind: str) -> NodeCommand:
    return NodeCommand(name, kind, ("no-such-command",))


def lose(supervisor: Supervisor, name: str) -> None:
    """As if it had died so often already that the next time is the last."""
    (child,) = (each for each in supervisor.children if each.command.name == name)
    child.deaths_in_a_row = GIVE_UP_AFTER - 1


def test_a_spared_node_that_dies_again_and_again_is_left_alone_while_others_run() -> None:
    robot = NodeCommand("sim", "sim", ("echo", "--help"))
    supervisor, told = begin(robot, broken("worker-a", "worker"), broken("worker-b", "worker"))
    try:
        lose(supervisor, "worker-a")
        end = f"worker-a crashed {GIVE_UP_AFTER} times in a row; not restarting it"

        def left() -> bool:
            assert supervisor.poll(spare=("worker",))
            return any(each.startswith(end) for each in told)

        until("it is left alone", left, READY_PATIENCE_S)
        assert supervisor.given_up is None
        until("the other one is started again", lambda: left() and starts(told, "worker-b") > 1)
        assert starts(told, "worker-a") == 1
    finally:
        supervisor.kill()


def starts(told: list[str], name: str) -> int:
    return sum(each.startswith(f"{name} started") for each in told)


@pytest.mark.parametrize("kind", ["worker", "camera"])
def test_when_nothing_else_is_left_or_can_be_spared_it_is_given_up(kind: str) -> None:
    supervisor, told = begin(broken("last", kind))
    try:
        lose(supervisor, "last")
        until("given up", lambda: not supervisor.poll(spare=("worker",)), READY_PATIENCE_S)
        assert supervisor.given_up is supervisor.children[0]
        assert told[-1] == f"last crashed {GIVE_UP_AFTER} times in a row; giving up"
    finally:
        supervisor.kill()


def test_a_node_that_runs_is_down_until_it_was_alive_and_not_when_it_hangs_later() -> None:
    supervisor, _ = begin(NodeCommand("sim", "sim", ("node", "sim")))
    try:
        assert [node.command.name for node in supervisor.down(())] == ["sim"]
        assert supervisor.down({"sim"}) == []
        assert supervisor.down(()) == []

        signal_group(supervisor.pids()["sim"], signal.SIGKILL)
        until("its end is seen", lambda: supervisor.poll() and supervisor.down(()) != [])
    finally:
        supervisor.kill()


def group_runs(group: int) -> bool:
    """Whether any process of that group is more than a zombie."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = stat.read_text().rpartition(") ")[2].split()[:3]
        except OSError:
            continue
        if int(its_group) == group and state not in "ZX":
            return True
    return False
