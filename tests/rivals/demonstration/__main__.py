"""Two other makers' robots on one bus; run it, and write its log and its pictures.

    make demo-rivals        # this, with both environments made

A WidowX AI behind the maker's library, whose controller is trossen-arm-sim's, and an arm of six
joints that an owner process of physicalai holds, both on one router. An agent asks the first for a
move into the table, corrects it, and lets a policy move the arm; the link to that policy is cut,
and mended. The other arm is moved by a policy of its own all the time. Then the same two orders by
the maker's library alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from camera_rig import free_endpoint
from chain import Chain, running_chain
from physicalai_rig import Owner
from trossen_rig import Controller, bring_home

from demonstration.agent import Agent
from demonstration.cut_link import CutLink
from demonstration.pictures import draw
from demonstration.story import Story, as_tables
from demonstration.without_us import into_the_table, killed_on_the_way, pressed_n
from vla_zenoh.keys import PRIMITIVES, worker_node
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import load_profile

WIDOWX = """
extends: widowx_ai
trossen: {{address: 127.0.0.1}}
workers: [scripted, shadow]
models: {{shadow: scripted}}
options: {{scripted: {{camera: ""}}, shadow: {{camera: ""}}}}
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_hz: 100, command_timeout_s: 0.25, state_timeout_s: 0.35}}
hosts: {{here: {{nodes: [router, arm, command, primitives]}}, gpu: {{nodes: [worker]}}}}
"""
OWNED = """
extends: widowx_ai
robot: {{name: owned, driver: physicalai}}
trossen: null
physicalai: {{name: rival, units: degrees, gripper_shut: 0.0, gripper_open: 0.044}}
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session: {{listen: [{endpoint}], connect: [{endpoint}]}}
timing: {{command_hz: 50, state_hz: 50, command_timeout_s: 0.25, state_timeout_s: 0.35}}
hosts: {{here: {{nodes: [arm, command, worker]}}}}
"""
INTO_THE_TABLE = [0.0, 2.0, 1.0, -0.4, 0.0, 0.0]
"""Joints with which the TCP is 8 cm below the table."""
ABOVE_IT = [0.0, 1.6, 1.0, -0.4, 0.0, 0.0]
"""And 6.6 cm above it."""
NAMES = [f"joint_{number}" for number in range(6)]
UP = 10
STEP_M = 0.01
STARTS_S, BEFORE_CUT_S, AFTERWARDS_S = 60.0, 1.0, 2.0
MOVES_M, STANDS_M = 0.01, 1e-3
CUT_TO = "link to the policy scripted"


class Lab:
    """Both robots, the policies and the agent."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, endpoint = stack, free_endpoint()
        widowx, owned = folder / "widowx.yaml", folder / "owned.yaml"
        widowx.write_text(WIDOWX.format(endpoint=endpoint))
        owned.write_text(OWNED.format(endpoint=endpoint))
        self.controller = stack.enter_context(Controller())
        bring_home()
        stack.enter_context(Owner("rival", "WidowX"))
        self.widowx = self._chain(folder, profile_file=widowx, host="here", also=[owned])
        self.owned = self._chain(folder, profile_file=owned)
        self.link = stack.enter_context(CutLink(int(endpoint.rpartition(":")[2])))
        self._worker("scripted", widowx, self.link.endpoint)
        self._worker("shadow", widowx, endpoint)
        self.there("scripted", "shadow", PRIMITIVES)
        self.agent = stack.enter_context(Agent(widowx))

    def _chain(self, folder: Path, **given: Any) -> Chain:
        chain = self._stack.enter_context(running_chain(folder, **given))
        chain.recorder.only = {"state": "arm#", "command": "command#"}
        return chain

    def _worker(self, name: str, profile: Path, endpoint: str) -> None:
        """Start a worker whose session goes by `endpoint`."""
        words = [sys.executable, "-m", "vla_zenoh", "worker", name, "--profile", str(profile)]
        process = self._stack.enter_context(
            subprocess.Popen([*words, "--connect", endpoint], stdout=subprocess.DEVNULL)
        )
        self._stack.callback(process.kill)

    def there(self, *workers: str) -> None:
        """Wait until these are on the bus."""
        wanted = {worker_node(name) for name in workers}
        chain = self.widowx
        chain.until(f"{workers} are there", lambda: wanted <= chain.client.alive, STARTS_S)

    def arm_stood(self, since_s: float) -> tuple[float, float]:
        """When the WidowX stood after `since_s` (wall clock), and how much higher."""
        found = self.widowx.recorder.track(int(since_s * 1e9))
        height_m = found.position_m[:, 2]
        moving = np.flatnonzero(abs(height_m - height_m[-1]) > STANDS_M)
        last = int(moving[-1]) if len(moving) else 0
        return float(found.stamp_ns[last] / 1e9), float(height_m[-1] - height_m[0])


def refused_and_corrected(lab: Lab, story: Story) -> None:
    """The agent asks for a move into the table, is told why not, and asks for another."""
    asked_s = story.tell("agent: move_to, joints with the TCP 79 mm below the table", "asks")
    answer = lab.agent.call("move_to", joints_rad=dict(zip(NAMES, INTO_THE_TABLE, strict=True)))
    back_s = story.tell(f"answer to the agent: {answer['reason']}: {answer['why']}", "refused")
    story.found["pressed_n"] = {"with": pressed_n(lab.controller)}
    story.found["refused_after_s"] = round(back_s - asked_s, 3)
    story.tell("agent: move_to, 66 mm above the table")
    answer = lab.agent.call("move_to", joints_rad=dict(zip(NAMES, ABOVE_IT, strict=True)))
    off_mm = 1e3 * answer["off_m"]
    story.tell(f"answer: {answer['reason']}, {off_mm:.2f} mm off", "reached")
    story.found["corrected"] = answer


def cut_in_motion(lab: Lab, story: Story) -> None:
    """The agent lets the policy move the arm, and the link to it is cut."""
    answers: list[Any] = []
    asked = {"worker": "scripted", "prompt": f"HARD: go up x{UP}", "until": {"done": True}}

    def run() -> None:
        answers.append(lab.agent.call("run", **asked, timeout_s=20))
        answers.append(time.time())

    from_m = lab.widowx.height_m()
    story.tell(f"agent: run scripted, 'HARD: go up x{UP}'; shadow is asked, too, and not obeyed")
    asking = threading.Thread(target=run)
    asking.start()
    lab.widowx.until(
        "it moves", lambda: answers or lab.widowx.height_m() > from_m + MOVES_M, STARTS_S
    )
    assert not answers, f"it never moved: {answers}; a computer this busy cannot show it"
    time.sleep(BEFORE_CUT_S)
    shadow = lab.widowx.client.status(worker_node("shadow"))
    assert shadow is not None
    lab.widowx.client.pop_events()
    lab.link.cut()
    cut_s = story.tell(f"{CUT_TO} cut", "cut")
    asking.join()
    answer, back_s = answers
    time.sleep(AFTERWARDS_S)
    for name, header, event in lab.widowx.client.pop_events():
        at_s = header.stamp_wall_ns / 1e9
        if at_s > cut_s and name == "command" and event.why:
            brakes = "brakes" if event.what.startswith("active->") else ""
            story.tell(f"{name}: {event.what}: {event.why}", brakes, at_s)
    at_s, further_m = lab.arm_stood(cut_s)
    story.tell(f"WidowX stands, {1e3 * further_m:.0f} mm further on", "stands", at_s)
    why = f"{answer['reason']}: {answer['why']}"
    story.tell(f"answer to the agent: {why}", "agent told", back_s)
    story.found["after_cut_s"] = {"stands": at_s - cut_s, "agent told": back_s - cut_s}
    _, _, chunks = shadow.detail["net"]["sent"]["delta/shadow"]
    story.found["shadow"] = {"chunks": chunks, "obeyed": shadow.detail["obeyed"]}
    story.tell(f"shadow: {chunks} chunks so far, none obeyed")
    lab.link.mend()
    story.tell(f"{CUT_TO} mended", "mended")
    lab.there("scripted")
    story.tell("scripted is on the bus again")
    stood_m = lab.widowx.height_m()
    left = max(1, round(UP - (stood_m - from_m) / STEP_M))
    asked["prompt"] = f"HARD: go up x{left}"
    story.tell(f"agent: run scripted, {asked['prompt']!r}: what is left, in whole steps")
    answer = lab.agent.call("run", **asked, timeout_s=20)
    time.sleep(AFTERWARDS_S)
    short_m = stood_m + left * STEP_M - lab.widowx.height_m()
    story.tell(f"answer: {answer['reason']}; {1e3 * short_m:.2f} mm short", "done")
    story.found["short_m"] = short_m


def track(chain: Chain, story: Story) -> dict[str, Any]:
    """Times and heights of an arm."""
    found = chain.recorder.track(int(story.began_s * 1e9))
    times_s = found.stamp_ns / 1e9 - story.began_s
    return {
        "t_s": times_s[::5].round(3).tolist(),
        "z_m": found.position_m[::5, 2].round(5).tolist(),
    }


def with_us(stack: ExitStack, folder: Path, story: Story) -> None:
    """Both robots, the agent and the cut link."""
    lab = Lab(stack, folder)
    lab.owned.activate_when_ready()
    lab.owned.client.set_prompt("HARD: go up x100000 within 0.05")
    story.begin()
    story.tell("arm of physicalai: its own policy moves it up and down, to the end")
    refused_and_corrected(lab, story)
    cut_in_motion(lab, story)
    state = lab.owned.state()
    story.tell(f"arm of physicalai: {state}")
    story.found["owned"] = state
    story.found["tracks"] = {
        "widowx": track(lab.widowx, story),
        "owned": track(lab.owned, story),
    }


def without_us(story: Story) -> None:
    """The same orders by the maker's library alone."""
    kinematics = make_kinematics(load_profile("widowx_ai"))

    def height_m(joints_rad: Any) -> float:
        return float(kinematics.forward(np.asarray(joints_rad)).position_m[2])

    path_rad = [
        [0.0, float(joint_rad), 1.0, -0.4, 0.0, 0.0] for joint_rad in np.linspace(1.2, 0.95, 101)
    ]
    story.found["pressed_n"]["without"] = into_the_table(INTO_THE_TABLE)
    short_m, modes = killed_on_the_way(path_rad, height_m)
    story.found["killed"] = {"short_m": short_m, "modes": modes}


def side_by_side(story: Story) -> None:
    """Both sides in words."""
    found = story.found
    pressed_n, after_s = found["pressed_n"], found["after_cut_s"]
    killed, modes = found["killed"], " and ".join(found["killed"]["modes"])
    into, dies, success = "move into the table", "what commands is cut off", "orders carried out"
    found["without"] = {
        into: f"presses with {pressed_n['without']:.0f} N, and nobody is told",
        dies: f"program killed: stands {1e3 * killed['short_m']:.0f} mm short, in mode {modes}; "
        "nobody is told",
        success: "0 of 2",
    }
    corrected = found["corrected"]["reason"] == "reached"
    arrived = abs(found["short_m"]) < STANDS_M
    found["with"] = {
        into: f"refused after {1e3 * found['refused_after_s']:.0f} ms, {pressed_n['with']:.0f} N; "
        "the agent is told why, and corrects it",
        dies: f"stands after {1e3 * after_s['stands']:.0f} ms, the agent is told why after "
        f"{1e3 * after_s['agent told']:.0f} ms, and lets it go on",
        success: f"{corrected + arrived} of 2",
    }


def main(out: str) -> None:
    """Run it, and write ``story.json``, ``story.md``, ``rivals.svg`` and ``rivals.png``."""
    folder = Path(out).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    story = Story()
    with ExitStack() as stack:
        with_us(stack, folder, story)
    without_us(story)
    side_by_side(story)
    told = story.as_json()
    (folder / "story.json").write_text(json.dumps(told, indent=1, default=str))
    (folder / "story.md").write_text(as_tables(told))
    draw(told, folder / "rivals.svg")
    print((folder / "story.md").read_text().partition("\n\n")[2], flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
