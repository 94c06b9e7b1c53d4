"""Eight robots, one worker obeyed and two in shadow, random faults: ``fleet.py --minutes 60``.

A real router, command nodes, arms and workers, each a process under its supervisor. An arm is
always where it was commanded to be and writes down when it was where, so that it costs little:
eight arms of MuJoCo do not fit two cores. At random, from a seed that is printed, one of the
workers, the router, a command node or an arm is killed, or the router is frozen for longer than its
lease, which cuts all links. Where ``RAY_PYTHON`` names a Python with Ray Serve, the second shadow
has two replicas there, and one of those is killed too. After each of them every robot must obey
again, and it is judged

- by what arms wrote down: each that had to stop stood within its bound, no other one stopped, and
  none that has to be activated moved before;
- by chunks: none came twice, and no command node counts more than were sent;
- by what processes hold: memory, file handles, threads, shared memory.

The exit code is 0 when nothing was found, 1 when something was, 2 when it could not go on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import zenoh
from camera_rig import free_endpoint, until
from chain import Chain, running_chain
from ledger import FRONT_OF_RAY, Ledger, segments
from ray_rig import VARIABLE, ray_worker, replicas
from two_robots import BOUNCE, write_bouncer

from vla_zenoh.bus.buffers import header_of
from vla_zenoh.errors import CodecError, NodeError, SessionError

HZ, STATE_HZ, RATE_HZ = 50, 25, 2.5
HORIZON, DT_S = 10, 0.1
GOOD, SHADES = "good", ("shade", "shade2")
COMMAND_S, STATE_S = 1.0, 2.0
"""Silence after which an arm brakes, as long as a profile may ask for: the computer is busy."""
WATCHDOG_S, BRAKE_S, BUSY_S = 0.5, 0.5, 0.5
BOUND_S = {
    GOOD: HORIZON * DT_S + WATCHDOG_S + BRAKE_S + BUSY_S,
    "router": max(HORIZON * DT_S + WATCHDOG_S, COMMAND_S, STATE_S) + BRAKE_S + BUSY_S,
    "freeze": max(HORIZON * DT_S + WATCHDOG_S, COMMAND_S, STATE_S) + BRAKE_S + BUSY_S,
    "command": COMMAND_S + BRAKE_S + BUSY_S,
    "arm": BUSY_S,
}
"""Fault -> in which an arm stands that is no longer told where to go."""
LEASE_MS, FREEZE_S = 1000, 3.0
REPLICAS = 2
WEIGHTS = {
    GOOD: 3,
    SHADES[0]: 2,
    SHADES[1]: 1,
    "replica": 2,
    "command": 3,
    "arm": 2,
    "router": 1,
    "freeze": 1,
}
QUIET_S, LIFE_S = (2.0, 6.0), 65.0
"""A node is killed again only after it lived for so long: else its supervisor gives it up."""
RECOVER_S, READY_S = 120.0, 300.0
STILL_M_S, STANDS_S, CREPT_M = 0.002, 0.2, 0.001
BETWEEN_M = 0.4, 0.55
"""Heights at which the models turn: an arm begins at 0.49 and goes at most 0.1 m in a chunk."""
ACTIVATION_S = 3.0
ALLOCATOR = {"MALLOC_ARENA_MAX": "2", "MALLOC_TRIM_THRESHOLD_": "131072"}
"""glibc keeps what a thread has freed in an arena of that thread, up to 60 MiB in a worker with the
threads of Zenoh and Ray: with two arenas what grows is what is held."""
ROW = 8 * 8
ARM = '''
import time
import numpy as np
from vla_zenoh.robot import Reading


class LoggedArm:
    """Always where it was commanded to be; one row of float64 a command: time and joints."""

    def __init__(self, file):
        self._file = open(file, "ab", buffering=0)
        # High above the table: without commands it goes on for COMMAND_S, up to 0.25 m.
        self._position_rad = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])

    def read(self):
        return Reading(position_rad=self._position_rad)

    def move(self, command):
        self._position_rad = np.array(command.position_rad)
        self._file.write(np.array([time.monotonic(), *self._position_rad]).tobytes())

    def grip(self, width_m, speed_m_s, force_n):
        pass
'''
ROBOT = """\
extends: panda_sim
robot: {{name: {name}, driver: arm, command: joint}}
arm: {{file: {folder}/arm.py, options: {{file: {folder}/{name}.flight}}}}
cameras: {{front: null, wrist: null}}
workers: [{workers}]
models: {{{models}}}
options: {{{options}}}
serves: {{{serves}}}
task: {{prompt: hold, rate_hz: {rate_hz}, worker: good}}
session: {{listen: [{endpoint}], connect: [{endpoint}], lease_ms: {lease_ms}}}
timing: {{command_timeout_s: {command_s}, state_timeout_s: {state_s}, watchdog_s: {watchdog_s},
  command_hz: {hz}, state_hz: {state_hz}}}
hosts: {{here: {{nodes: [{nodes}]}}, gpu: {{nodes: [worker], workers: [{here}]}}}}
"""


@dataclass
class Found:
    """What there is to tell."""

    seed: int
    robots: int
    minutes: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    stood_s: dict[str, list[float]] = field(default_factory=dict)
    went_on: int = 0
    """Robots that had a chunk of the worker that was started again before they stood."""
    recovery_s: list[float] = field(default_factory=list)
    chunks: int = 0
    violations: list[str] = field(default_factory=list)
    leaks: list[str] = field(default_factory=list)
    failure: str = ""

    @property
    def code(self) -> int:
        return 2 if self.failure else int(bool(self.violations or self.leaks))


class Way(NamedTuple):
    """When an arm had not moved for `STANDS_S` any more, and how far it went after that."""

    stood_s: float
    then_m: float


class Chunks:
    """Chunks of the obeyed worker that came to a robot: how many, and which came twice."""

    def __init__(self, chain: Chain) -> None:
        self.count, self.twice = 0, 0
        self._seen: set[tuple[str, int]] = set()
        self._began_s: dict[str, float] = {}
        self._lock = threading.Lock()
        self._subscriber = chain.session.declare_subscriber(
            chain.profile.keys.delta(GOOD), zenoh.handlers.Callback(self._take, indirect=False)
        )

    def _take(self, sample: zenoh.Sample) -> None:
        with suppress(CodecError), self._lock:
            header = header_of(sample)
            self.twice += (header.source, header.seq) in self._seen
            self._seen.add((header.source, header.seq))
            self._began_s.setdefault(header.source, time.monotonic())
            self.count += 1

    def next_worker_s(self, since_s: float) -> float:
        """When the first chunk of a worker came that was started after `since_s`; inf: none."""
        with self._lock:
            later = [at_s for at_s in self._began_s.values() if at_s > since_s]
        return min(later, default=math.inf)


class Fleet:
    """See the module."""

    def __init__(
        self,
        folder: Path,
        robots: dict[str, Chain],
        gpu: Chain,
        found: Found,
        front: dict[str, int],
    ) -> None:
        self._folder, self._robots, self._gpu, self.found = folder, robots, gpu, found
        self._front = front
        self._random = random.Random(found.seed)
        self._chunks = {name: Chunks(chain) for name, chain in robots.items()}
        self._killed_s: dict[tuple[str, str], float] = {}
        self._first = next(iter(robots))
        self._kinematics: Any = None
        self._ledger = Ledger(self._pids)

    def _pids(self) -> dict[str, int]:
        own = {
            f"{node} of {name}": pid
            for name, chain in self._robots.items()
            for node, pid in chain.living().items()
        }
        return own | self._gpu.living() | self._front

    def run(self, minutes: float) -> None:
        """So long; the last fifth without faults, in which nothing may grow."""
        began_s = time.monotonic()
        try:
            self._recover(READY_S)
            while time.monotonic() - began_s < 48 * minutes:
                self._one()
            calm_s = time.monotonic()
            while time.monotonic() - began_s < 60 * minutes:
                time.sleep(1.0)
            self._recover(RECOVER_S)
            for growth in self._ledger.growth_since(calm_s + 30.0):
                self.found.leaks += growth.leaks
        except (AssertionError, SessionError, NodeError, OSError) as error:
            self.found.failure = f"{type(error).__name__}: {error}"
        finally:
            self.found.minutes = round((time.monotonic() - began_s) / 60, 1)
            for growth in self._ledger.growth():
                self.found.leaks += growth.leaks
            self._ledger.close()
        self._judge_chunks()

    # -- faults -------------------------------------------------------------------------------
    def _one(self) -> None:
        fault = self._random.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
        if fault == "replica":
            return self._replica()
        name = self._random.choice(list(self._robots))
        where, node = {
            "command": (name, "command"),
            "arm": (name, "arm"),
            "router": (self._first, "router"),
            "freeze": (self._first, "router"),
        }.get(fault, ("gpu", f"worker-{fault}"))
        chain = self._gpu if where == "gpu" else self._robots[where]
        pids = chain.host.supervisor.pids()
        node = next((each for each in pids if each.startswith(node)), node)
        young = time.monotonic() - self._killed_s.get((where, node), -math.inf) < LIFE_S
        if node not in pids or young:
            time.sleep(0.5)
            return None
        for each in self._robots.values():
            each.client.pop_events()
        pid, hit_s = pids[node], time.monotonic()
        if fault == "freeze":
            os.kill(pid, signal.SIGSTOP)
            time.sleep(FREEZE_S)
            os.kill(pid, signal.SIGCONT)
            self._ledger.links_broke()
        else:
            os.kill(pid, signal.SIGKILL)
            self._killed_s[where, node] = hit_s
        return self._after(fault, where, hit_s)

    def _replica(self) -> None:
        found = replicas(self._folder)
        if len(found) < REPLICAS:
            time.sleep(0.5)
            return
        for each in self._robots.values():
            each.client.pop_events()
        os.kill(self._random.choice(sorted(found)), signal.SIGKILL)
        self._after("replica", "ray", time.monotonic())

    def _after(self, fault: str, where: str, hit_s: float) -> None:
        time.sleep(max(BOUND_S.values()) + STANDS_S)
        self.found.faults[fault] += 1
        self._judge(fault, where, hit_s)
        began_s = time.monotonic()
        self._recover(RECOVER_S)
        self.found.recovery_s.append(round(time.monotonic() - began_s, 1))
        said = f"{fault} of {where}"
        print(f"{time.strftime('%H:%M:%S')} {said:<22} again after {self.found.recovery_s[-1]} s")
        sys.stdout.flush()
        time.sleep(self._random.uniform(*QUIET_S))

    def _recover(self, patience_s: float) -> None:
        give_up_s = time.monotonic() + patience_s
        while True:
            left = [name for name, chain in self._robots.items() if not self._obeys(chain)]
            if not left:
                return
            if time.monotonic() > give_up_s:
                story = self._robots[left[0]].story()
                raise NodeError(f"{left} do not obey again in {patience_s:g} s\n{story}")
            time.sleep(0.2)

    @staticmethod
    def _obeys(chain: Chain) -> bool:
        task = chain.client.task
        if task is None:
            return False
        if chain.state() == "active" and task.prompt == BOUNCE and task.worker == GOOD:
            return True
        with suppress(SessionError):  # preflight says what is missing
            if task.worker != GOOD:
                chain.client.set_worker(GOOD, 1.0)
            if task.prompt != BOUNCE:
                chain.client.set_prompt(BOUNCE, 1.0)
            if chain.state() in ("stopped", "fault"):
                chain.client.publish(chain.client.keys.reset, "")
            chain.client.activate(ACTIVATION_S)
        return False

    # -- judging ------------------------------------------------------------------------------
    def _judge(self, fault: str, where: str, hit_s: float) -> None:
        for name, chain in self._robots.items():
            ended = bool(chain.events("active->inactive"))
            own = where == name and fault in ("command", "arm")
            if ended and not (own or fault in (GOOD, "router", "freeze")):
                why = chain.detail("why")
                self.found.violations.append(f"{name} stopped after {fault} of {where}: {why}")
            # A router that is back at once stops nobody.
            if own or fault in (GOOD, "freeze") or (ended and fault == "router"):
                self._judge_stop(fault, name, hit_s, waits=own or ended)

    def _judge_stop(self, fault: str, name: str, hit_s: float, *, waits: bool) -> None:
        """A robot that had to stop: in time, and for as long as it `waits` for an activation."""
        way = self._way(name, hit_s)
        stood_s = way.stood_s
        if fault == GOOD and self._chunks[name].next_worker_s(hit_s) < hit_s + stood_s:
            self.found.went_on += 1
            return
        self.found.stood_s.setdefault(fault, []).append(round(stood_s, 3))
        if stood_s > BOUND_S[fault]:
            self.found.violations.append(
                f"{name} stood {stood_s:.2f} s after {fault}, {BOUND_S[fault]:.2f} s are its bound"
            )
        if waits and fault != "arm" and way.then_m > CREPT_M:
            self.found.violations.append(
                f"{name} moved by {way.then_m * 1e3:.1f} mm by itself after {fault}"
            )

    def _way(self, name: str, since_s: float) -> Way:
        """What the arm did from `since_s` on."""
        raw = (self._folder / f"{name}.flight").read_bytes()
        rows = np.frombuffer(raw[: len(raw) // ROW * ROW]).reshape(-1, 8)[-40 * HZ :]
        rows = rows[rows[:, 0] >= since_s]
        if len(rows) < 2:
            return Way(0.0, 0.0)
        place_m = np.array([self._place_m(name, joints) for joints in rows[:, 1:]])
        apart_s = np.diff(rows[:, 0]).clip(1e-4)
        fast = rows[1:, 0][np.linalg.norm(np.diff(place_m, axis=0), axis=1) / apart_s > STILL_M_S]
        last_s = since_s
        for at_s in fast.tolist():
            if at_s - last_s > STANDS_S:
                break
            last_s = at_s
        then = place_m[rows[:, 0] > last_s + STANDS_S]
        then_m = float(np.ptp(then, axis=0).max()) if len(then) else 0.0
        return Way(last_s - since_s, then_m)

    def _place_m(self, name: str, joints: Any) -> Any:
        if self._kinematics is None:
            from vla_zenoh.kinematics.kinematics import arm_kinematics

            self._kinematics = arm_kinematics(self._robots[name].profile.robot)
        return self._kinematics.forward(joints).position_m

    def _judge_chunks(self) -> None:
        for name, came in self._chunks.items():
            self.found.chunks += came.count
            if came.twice:
                self.found.violations.append(f"{came.twice} chunks came twice to {name}")
            counted = self._robots[name].detail("accepted_chunks") or 0
            if counted > came.count:
                self.found.violations.append(f"{name} counts {counted} of {came.count} chunks")


def write_robots(folder: Path, count: int, *, with_replicas: bool) -> list[Path]:
    """Profiles of all robots, their arm and their models."""
    (folder / "arm.py").write_text(ARM)
    write_bouncer(folder / "own.py", horizon=HORIZON, slow_s=0.02, between_m=BETWEEN_M)
    names = [f"r{number + 1}" for number in range(count)]
    models = {name: "./own.py" for name in (GOOD, *SHADES)}
    options, here = "", list(models)
    if with_replicas:
        here.remove(SHADES[1])
        models[SHADES[1]] = "ray_serve"
        options = f'{SHADES[1]}: {{model: {folder}/own.py, replicas: "{REPLICAS}"}}'
    endpoint = free_endpoint()
    for name in names:
        (folder / f"{name}.yaml").write_text(
            ROBOT.format(
                name=name,
                folder=folder,
                workers=", ".join(models),
                here=", ".join(here),
                models=", ".join(f"{each}: {path}" for each, path in models.items()),
                options=options,
                serves=(
                    ", ".join(f"{each}: [{', '.join(names)}]" for each in models)
                    if name == names[0]
                    else ""
                ),
                rate_hz=RATE_HZ,
                endpoint=endpoint,
                lease_ms=LEASE_MS,
                command_s=COMMAND_S,
                state_s=STATE_S,
                watchdog_s=WATCHDOG_S,
                hz=HZ,
                state_hz=STATE_HZ,
                nodes="router, arm, command" if name == names[0] else "arm, command",
            )
        )
    return [folder / f"{name}.yaml" for name in names]


def main() -> int:
    """Soak a fleet, and tell what was found."""
    parser = argparse.ArgumentParser(description="Soak a fleet of robots.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="0: another one each time")
    asked = parser.parse_args()
    seed = asked.seed or int.from_bytes(os.urandom(3), "big") + 1
    found = Found(seed, asked.robots)
    print(f"seed {seed}")
    before, with_ray = segments(), VARIABLE in os.environ
    os.environ |= ALLOCATOR
    with tempfile.TemporaryDirectory(prefix="fleet-") as made, ExitStack() as stack:
        folder = Path(made)
        files = write_robots(folder, asked.robots, with_replicas=with_ray)
        robots: dict[str, Chain] = {}
        front: dict[str, int] = {}
        for file in files:
            chain = running_chain(folder, profile_file=file, host="here")
            robots[file.stem] = stack.enter_context(chain)
            if with_ray and not front:  # before the others: Ray gives up on a busy computer
                pid = stack.enter_context(ray_worker(folder, file, SHADES[1]))
                front[f"{SHADES[1]} {FRONT_OF_RAY}"] = pid
                until("both replicas", lambda: len(replicas(folder)) == REPLICAS, READY_S)
        gpu = stack.enter_context(running_chain(folder, profile_file=files[0], host="gpu"))
        fleet = Fleet(folder, robots, gpu, found, front)
        fleet.run(asked.minutes)
    after = segments()
    if after.orphans > before.orphans + 4:
        found.leaks.append(f"shared memory: {before.orphans} -> {after.orphans} without a process")
    print(json.dumps({**asdict(found), "faults": dict(found.faults)}, indent=2))
    return found.code


if __name__ == "__main__":
    sys.exit(main())
