"""Runs the whole chain with random faults for as long as is wanted: ``make soak MINUTES=60``.

Real nodes under the supervisor. At random, from a seed that is printed: nodes are killed or frozen,
strangers write junk on every key, prompts, workers and rates are changed, the arm is given and
taken away. After each of them the arm must obey again, and it is judged

- by the simulator's own states: inside the workspace, within the limits of speed and acceleration;
- by what nodes refused: each refusal must follow from what was just done, or from a stall of the
  computer that a thread of ours saw;
- by what processes hold: memory, file handles, threads, shared memory.

The exit code is 0 when nothing was found, 1 when something was, 2 when it could not go on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import zenoh
from chain import Chain, running_chain
from junk import all_junk, all_keys, samples_of
from ledger import Growth, Ledger, segments
from refusals import EXPLAINS, STALL_S, Refusals, Witness, unexplained
from report import Found, line, show
from rich.console import Console

from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.policy.loader import find_model

WORKERS = ("scripted", "twin")
PROMPTS = (
    "HARD: go up within 0.1",
    "HARD: go down within 0.1",
    "HARD: yaw left within 0.2",
    "HARD: pitch up within 0.1",
    "hold",
)
HIGH_M, LOW_M = 0.50, 0.25
"""Beyond these the next prompt leads back."""
WEIGHTS = {
    "prompt": 4,
    "worker": 2,
    "rate": 2,
    "toggle": 2,
    "stop": 1,
    "kill": 5,
    "freeze": 3,
    "junk": 3,
}
KILLED = {"worker-scripted": 3, "worker-twin": 3, "camera": 3, "sim": 2, "command": 2, "router": 1}
DEADLY = ("kill", "freeze")
CALM_SHARE, CALM_WARM_S = 0.2, 30.0
"""So much of the time, the last, is calm; what the last death has left comes to rest before it is
looked whether anything grows."""
QUIET_S = (1.0, 5.0)
FREEZE_S = (0.05, 3.0)
LEASE_MS = 1000
"""The default, not that of the tests: the longest freezes cost a node its link."""
LIFE_S = 65.0
"""A node is killed again only after it lived for so long: else its supervisor gives it up."""
JUNK = 400
SETTLED_S = 1.2
"""Two reports: the counters of what just happened have been told."""
FRESH_S = 1.5
PATIENCE_S, RECOVER_S = 60.0, 90.0
POLL_S = 0.1
WARM_S = 15.0
"""At 10 Hz all the chunks that a status tells latencies of were made meanwhile."""
SPEED_TOLERANCE, ARM_TOLERANCE, COMMAND_TOLERANCE = 1.15, 2.7, 1.1
"""As in tests/fault/test_dead_nodes.py."""
BOX_TOLERANCE_M = 0.005
EXACT_M = 0.0015
MORE_SEGMENTS = 4
"""What a kill -9 leaves stands until the next Zenoh process cleans up."""
MEASURER = "soak"


class Soak:
    """See the module.

    Args:
        chain: at work.
        seed: of everything random.
        say: for what goes on.
    """

    def __init__(self, chain: Chain, seed: int, say: Callable[[str], None]) -> None:
        self.chain, self.found, self._say = chain, Found(seed), say
        self._random = random.Random(seed)
        random.seed(seed)  # the junk's
        self._whom = ""
        self._weights: dict[str, int] = dict(WEIGHTS)
        self._calm_s = 0.0
        self._do: dict[str, Callable[[], str | None]] = {
            "prompt": self._prompt,
            "worker": self._worker,
            "rate": self._rate,
            "toggle": self._toggle,
            "stop": self._stop,
            "kill": self._kill,
            "freeze": self._freeze,
            "junk": self._strangers,
        }
        self._born_s: dict[str, tuple[int, float]] = {}
        self._refusals, self._witness = Refusals(), Witness()
        self._ledger = Ledger(lambda: {**chain.living(), MEASURER: os.getpid()})

    # -- all of it ----------------------------------------------------------------------------
    def run(self, minutes: float) -> Found:
        """Soak for so long."""
        found, began_s = self.found, time.monotonic()
        try:
            self._begin()
            end_s = time.monotonic() + 60 * minutes
            calm_s = 60 * minutes * CALM_SHARE
            while time.monotonic() < end_s - calm_s:
                self._one()
            self._begin_calm()
            while time.monotonic() < end_s:
                self._one()
            self._end()
        except (AssertionError, SessionError, NodeError, OSError) as error:
            found.failure = f"{type(error).__name__}: {error}"
        finally:
            found.minutes = round((time.monotonic() - began_s) / 60, 2)
            self._ledger.close()
            self._witness.close()
        return found

    def _begin(self) -> None:
        chain = self.chain
        chain.activate_when_ready(PATIENCE_S)
        self.chain.until("all nodes", self._all_fresh, PATIENCE_S)
        chain.client.set_prompt(PROMPTS[0])
        time.sleep(WARM_S)
        self._junk = all_junk(chain, samples_of(chain))
        self._refusals.since(self._statuses())
        self._witness.worst_s()
        self._note("start")
        chain.recorder.forget()

    def _begin_calm(self) -> None:
        """From here on nothing dies: who still grows, grows for ever."""
        self._weights = {name: weight for name, weight in WEIGHTS.items() if name not in DEADLY}
        self._say("calm: nothing is killed or frozen any more")
        self._calm_s = time.monotonic() + CALM_WARM_S

    def _end(self) -> None:
        found, chain = self.found, self.chain
        chain.client.set_worker(WORKERS[0])
        chain.client.set_rate(10.0)
        chain.client.set_prompt("HARD: go up within 0.1")
        time.sleep(WARM_S)
        self._note("end")
        way_m = chain.go("down", 5)
        if abs(way_m + 0.05) > EXACT_M:
            found.violations.append(f"at the end 5 steps down went {way_m * 1e3:.2f} mm")
        for growth in self._ledger.growth():
            # The program that measures keeps samples: it is shown and not judged.
            found.leaks += growth.leaks if growth.node != MEASURER else []
        calm = self._ledger.growth_since(self._calm_s)
        for growth in calm:
            found.leaks += growth.leaks if growth.node != MEASURER else []
        found.held["calm"] = [_life(growth) for growth in calm]
        found.held["lives"] = [_life(growth) for growth in self._ledger.growth()]
        before, after = found.held["start"]["segments"], found.held["end"]["segments"]
        if after.orphans > before.orphans + MORE_SEGMENTS:
            found.leaks.append(
                f"shared memory: {before.orphans} -> {after.orphans} segments that nobody maps"
            )

    def _note(self, when: str) -> None:
        status = self.chain.client.status("command")
        assert status is not None
        self.found.held[when] = {
            "nodes": {name: held._asdict() for name, held in self._ledger.newest().items()},
            "segments": segments(),
        }
        self.found.latency[when] = {
            "stages_ms": {name: list(values) for name, values in status.latency_ms.items()},
            "tick_us": status.detail.get("tick_us"),
            "late_us": status.detail.get("late_us"),
        }

    # -- one thing after the other ------------------------------------------------------------
    def _one(self) -> None:
        action = self._random.choices(list(self._weights), list(self._weights.values()))[0]
        began_s, self._whom = time.monotonic(), ""
        said = self._do[action]()
        if said is None:
            return
        done_s = time.monotonic()
        self._recover()
        took_s = time.monotonic() - done_s
        time.sleep(max(SETTLED_S, self._random.uniform(*QUIET_S)))
        self._judge(action, said, began_s)
        self.found.actions[action] += 1
        self.found.recovery_s.setdefault(action, []).append(round(took_s, 2))

    def _recover(self) -> None:
        """Until all nodes speak and the arm obeys; a busy computer may take it away again."""
        chain, give_up_s = self.chain, time.monotonic() + RECOVER_S
        while chain.state() != "active" or not self._all_fresh():
            if time.monotonic() > give_up_s:
                raise NodeError(f"the arm does not obey again in {RECOVER_S:g} s")
            if chain.state() in ("stopped", "fault"):
                chain.client.publish(chain.client.keys.reset, "")
            elif chain.state() not in ("active", "holding") and self._all_fresh():
                with suppress(SessionError):  # preflight says what is missing
                    chain.client.activate()
            time.sleep(POLL_S)

    def _all_fresh(self) -> bool:
        names = {"sim", "command", "camera", *(f"worker-{name}" for name in WORKERS)}
        pids = self.chain.host.supervisor.pids()
        snapshot = self.chain.client.snapshot()
        return names <= pids.keys() and all(
            name in snapshot
            and snapshot[name][1] < FRESH_S
            and snapshot[name][2]
            and snapshot[name][0].pid == pids[name]
            for name in names
        )

    def _statuses(self) -> dict[str, Any]:
        return {name: status for name, (status, _, _) in self.chain.client.snapshot().items()}

    # -- judging ------------------------------------------------------------------------------
    def _judge(self, action: str, said: str, began_s: float) -> None:
        found = self.found
        stall_s = self._witness.worst_s()
        found.stalls += stall_s > STALL_S
        found.worst_stall_s = max(found.worst_stall_s, stall_s)
        refused = self._refusals.since(self._statuses())
        found.refused.setdefault(action, Counter()).update(refused)
        strange = unexplained(refused, action, stall_s, self._whom)
        found.unexplained += [f"{name} x{count} after: {said}" for name, count in strange.items()]
        faults = self._violations()
        found.violations += [f"{fault} after: {said}" for fault in faults]
        self.chain.recorder.forget()
        words = [f"{said:<44} {time.monotonic() - began_s:5.1f} s  stall {stall_s * 1e3:4.0f} ms"]
        words += [f"refused {dict(refused)}"] if refused and action != "junk" else []
        words += [f"?? without a cause: {name}" for name in strange]
        words += [f"!! {fault}" for fault in faults]
        self._say("  ".join(words))

    def _violations(self) -> list[str]:
        chain, limits = self.chain, self.chain.profile.limits
        every, out = chain.recorder.track(), []
        most = limits.translation
        for source in set(every.sources):
            track = every.of(source)
            if len(track.stamp_ns) < 10:
                continue
            box = limits.workspace
            for axis, (low, high) in zip("xyz", (box.x_m, box.y_m, box.z_m), strict=True):
                where = track.position_m[:, "xyz".index(axis)]
                if where.min() < low - BOX_TOLERANCE_M or where.max() > high + BOX_TOLERANCE_M:
                    out.append(f"{axis} in [{where.min():.4f}, {where.max():.4f}] m")
            speed, change = float(np.abs(track.twist[:, :3]).max()), track.hardest_change()
            self.found.fastest_m_s = max(self.found.fastest_m_s, speed)
            self.found.hardest_m_s2 = max(self.found.hardest_m_s2, change)
            if speed > most.velocity_m_s * SPEED_TOLERANCE:
                out.append(f"{speed:.3f} m/s")
            if change > most.acceleration_m_s2 * ARM_TOLERANCE:
                out.append(f"{change:.2f} m/s^2")
        commanded = chain.recorder.hardest_command()
        if commanded > most.acceleration_m_s2 * COMMAND_TOLERANCE:
            out.append(f"{commanded:.2f} m/s^2 commanded")
        return out

    # -- what is done -------------------------------------------------------------------------
    def _prompt(self) -> str:
        prompt = self._random.choice(PROMPTS)
        height_m = self.chain.height_m()
        if height_m > HIGH_M:
            prompt = PROMPTS[1]
        elif height_m < LOW_M:
            prompt = PROMPTS[0]
        self.chain.client.set_prompt(prompt, PATIENCE_S)
        return f"prompt {prompt}"

    def _worker(self) -> str:
        task = self.chain.client.task
        other = next(name for name in WORKERS if task is None or name != task.worker)
        give_up_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.chain.client.set_worker(other, PATIENCE_S)
            except SessionError:  # its pictures are late, say; whether that may be is judged later
                if time.monotonic() > give_up_s:
                    raise
                time.sleep(POLL_S)
            else:
                return f"worker {other}"

    def _rate(self) -> str:
        rate_hz = round(self._random.uniform(2.0, 15.0), 1)
        self.chain.client.set_rate(rate_hz, PATIENCE_S)
        return f"rate {rate_hz} Hz"

    def _toggle(self) -> str:
        if not self.chain.client.deactivate(PATIENCE_S):
            raise NodeError("the arm does not come to rest")
        return "deactivate, activate"

    def _stop(self) -> str:
        self.chain.session.put(self.chain.profile.keys.stop, b"")
        self.chain.until("stopped", lambda: self.chain.state() == "stopped", PATIENCE_S)
        return "stop, reset"

    def _kill(self) -> str | None:
        pids, now_s = self.chain.host.supervisor.pids(), time.monotonic()
        for name, pid in pids.items():
            if self._born_s.get(name, (0, 0.0))[0] != pid:
                first = name not in self._born_s
                self._born_s[name] = (pid, now_s - LIFE_S if first else now_s)
        kinds = {name: name if name in KILLED else "router" for name in pids}
        old = [name for name in pids if now_s - self._born_s[name][1] >= LIFE_S]
        if not old:
            return None
        name = self._random.choices(old, [KILLED[kinds[one]] for one in old])[0]
        pid, self._whom = pids[name], name
        os.kill(pid, signal.SIGKILL)
        self.found.killed[name] += 1
        self.chain.until(
            f"another {name}",
            lambda: self.chain.host.supervisor.pids().get(name, pid) != pid,
            PATIENCE_S,
        )
        self._born_s[name] = (self.chain.host.supervisor.pids()[name], time.monotonic())
        return f"kill -9 {name}"

    def _freeze(self) -> str:
        pids = self.chain.host.supervisor.pids()
        name = self._whom = self._random.choice(sorted(pids))
        seconds = self._random.uniform(*FREEZE_S)
        os.kill(pids[name], signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            os.kill(pids[name], signal.SIGCONT)
        return f"freeze {name} {seconds:.2f} s"

    def _strangers(self) -> str:
        keys = all_keys(self.chain.profile.keys)
        pictures = (keys["camera_raw"], keys["camera_jpeg"])
        plain = zenoh.Encoding.ZENOH_BYTES
        for piece in itertools.islice(self._junk, JUNK):
            encoding = plain.with_schema("rgb8;9999x9999") if piece.key in pictures else plain
            self.chain.session.put(
                piece.key, piece.payload, attachment=piece.attachment, encoding=encoding
            )
            time.sleep(0.001)
        return f"{JUNK} pieces of junk"


def _life(growth: Growth) -> dict[str, Any]:
    return {
        "node": growth.node,
        "life_s": round(growth.life_s),
        "heap_mib": [growth.first.heap_mib, growth.last.heap_mib],
    }


def main() -> int:
    """Soak, and tell what was found."""
    parser = argparse.ArgumentParser(description="Soak the whole chain.")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0, help="0: another one each time")
    parser.add_argument("--json", action="store_true", help="print JSON on stdout")
    asked = parser.parse_args()
    seed = asked.seed or int.from_bytes(os.urandom(3), "big") + 1
    screen = Console(stderr=True, highlight=False)

    def say(words: str) -> None:
        screen.print(f"[dim]{time.strftime('%H:%M:%S')}[/] ", end="")
        screen.print(words, markup=False, soft_wrap=True)

    say(f"seed {seed}")
    with tempfile.TemporaryDirectory(prefix="soak-") as made:
        folder = Path(made)
        (folder / "models").mkdir()
        shutil.copy(find_model("scripted").path, folder / "models" / "twin.py")
        os.environ["VLA_ZENOH_PATH"] = str(folder)
        more = f"workers: [{', '.join(WORKERS)}]\n"
        with running_chain(folder, more=more, lease_ms=LEASE_MS) as chain:
            soak = Soak(chain, seed, say)
            found = soak.run(asked.minutes)
            story = chain.story() if found.failure else ""
    if asked.json:
        print(json.dumps(found.to_dict(), indent=2))
    else:
        show(found)
    say(line(found))
    if story:
        screen.print(story, markup=False)
    return found.code


if __name__ == "__main__":
    assert set(EXPLAINS) == set(WEIGHTS)
    sys.exit(main())
