"""Runs in the environment of Inspect Robots: its own eval with our arm, as an installed plug-in.

    python inspect_arm_process.py PROFILE VERB [LOG_DIR]

The last line of the output is JSON, but of what runs until it is killed.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

import numpy as np

registry = import_module("inspect_robots.registry")
HZ, STEPS, STEP_RAD, JOINT = 10.0, 10, 0.02, 0


class Turn:
    """Turns the first joint, then stands: absolute targets, one each time it is asked."""

    def __init__(self, arm: Any, steps: int, then: int, aside_rad: float = 0.0) -> None:
        policy = import_module("inspect_robots.policy")
        self.info = policy.PolicyInfo(name="turn", action_space=arm.info.action_space)
        self.config = policy.PolicyConfig()
        self._steps, self._then, self._aside_rad = steps, then, aside_rad
        self.at: Any = None
        self.refused: list[str] = []
        self._asked = 0

    def reset(self, scene: Any) -> None:
        self.at, self._asked, self.refused = None, 0, []

    def act(self, seen: Any) -> Any:
        types = import_module("inspect_robots.types")
        if self.at is None:
            self.at = np.array(seen.state["joint_pos"], float)
        if why := seen.extra.get("refused"):
            self.refused.append(why)
        self._asked += 1
        target = self.at.copy()
        if self._asked <= self._steps:
            self.at[JOINT] += STEP_RAD
            target = self.at.copy()
        elif self._asked == self._steps + 1 and self._aside_rad:
            target[1] += self._aside_rad  # once, and out of reach
        over = self._asked >= self._steps + self._then
        meta = {"request_stop": True, "stop_reason": "done"} if over else {}
        return types.ActionChunk(actions=[types.Action(data=target, meta=meta)])


def run(arm: Any, policy: Any, folder: str, steps: int = 2000) -> Any:
    """One trial."""
    scene = import_module("inspect_robots.scene").Scene(id="one", instruction="turn")
    scorer = registry.resolve("scorer", "episode_length")
    task = import_module("inspect_robots.task").Task(
        name="turn", scenes=[scene], scorer=scorer, max_steps=steps
    )
    (log,) = import_module("inspect_robots.eval").eval(task, policy, arm, log_dir=folder)
    return log


def tell(log: Any, **more: Any) -> None:
    print(json.dumps({"status": log.status, "error": str(log.error or ""), **more}), flush=True)


def turn(arm: Any, folder: str, aside_rad: float = 0.0) -> None:
    policy = Turn(arm, STEPS, 25, aside_rad)
    began: list[Any] = []
    seen = arm.reset

    def reset(scene: Any, *, seed: int | None = None) -> Any:
        began.append(seen(scene, seed=seed))
        return began[-1]

    arm.reset = reset
    log = run(arm, policy, folder)
    moved = arm.step(import_module("inspect_robots.types").Action(data=policy.at))
    at = np.array(moved.observation.state["joint_pos"])
    off_rad = float(np.abs(at - policy.at)[:-1].max())
    turned_rad = float(at[JOINT] - began[0].state["joint_pos"][JOINT])
    tell(log, off_rad=off_rad, turned_rad=turned_rad, refused=policy.refused)


def agent(arm: Any, folder: str) -> None:
    """Their LLM agent, with a model of two moves: one that our limits refuse, then another."""
    httpx, agents = import_module("httpx"), import_module("inspect_robots_agent")
    label = arm.info.action_space.semantics.dim_labels[1]
    profile = import_module("vla_zenoh.profile").load_profile("panda_sim")
    moves = [profile.robot.home_rad[1] + aside_rad for aside_rad in (0.5, 0.1)]
    heard: list[str] = []

    def answer(request: Any) -> Any:
        body = json.loads(request.content)
        heard[:] = [str(m["content"]) for m in body["messages"] if m["role"] == "tool"]
        calls = sum(m["role"] == "assistant" for m in body["messages"])
        if calls < len(moves):
            name = "move_joints"
            given = {"targets": {label: moves[calls]}, "note": "to where it was asked"}
        else:
            name, given = "done", {"summary": "there", "hindsight": "none"}
        function = {"name": name, "arguments": json.dumps(given)}
        call = {"id": f"c{calls}", "type": "function", "function": function}
        message = {"role": "assistant", "content": None, "tool_calls": [call]}
        return httpx.Response(200, json={"choices": [{"message": message}]})

    policy = agents.LLMAgentPolicy(
        model="scripted",
        base_url="http://llm.invalid/v1",
        transport=httpx.MockTransport(answer),
        pre_check=arm.pre_check,
        max_speed_frac=0.5,
    )
    log = run(arm, policy, folder)
    tell(log, heard=heard)


def endless(arm: Any, folder: str) -> None:
    """Turns for 10 s, then stands, for ever."""
    print("READY", flush=True)
    log = run(arm, Turn(arm, 100, 100_000), folder, 100_000)
    tell(log)


def main(profile: str, verb: str, folder: str) -> None:
    arm = registry.resolve("embodiment", "vla_zenoh", profile=profile, cameras="", rate_hz=HZ)
    try:
        if verb == "aside":
            turn(arm, folder, 3.0)
        else:
            {"turn": turn, "agent": agent, "endless": endless}[verb](arm, folder)
    finally:
        arm.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
