"""Runs in the environment of Inspect Robots: its LLM agent and our embodiment, without an arm.

The agent's model is two moves: one that our limits refuse, then another. Prints JSON: what the
agent was told, and where its motion goes.
"""

from __future__ import annotations

import json
from importlib import import_module
from typing import Any

import numpy as np

PROFILE = "panda_sim"
ASIDE_RAD = (0.5, 0.1)


def main() -> None:
    registry, httpx = import_module("inspect_robots.registry"), import_module("httpx")
    arm = registry.resolve("embodiment", "vla_zenoh", profile=PROFILE, cameras="")
    label = arm.info.action_space.semantics.dim_labels[1]
    robot = import_module("vla_zenoh.profile").load_profile(PROFILE).robot
    heard: list[str] = []

    def answer(request: Any) -> Any:
        body = json.loads(request.content)
        heard[:] = [str(m["content"]) for m in body["messages"] if m["role"] == "tool"]
        calls = sum(m["role"] == "assistant" for m in body["messages"])
        given = {"targets": {label: robot.home_rad[1] + ASIDE_RAD[calls]}, "note": "as asked"}
        function = {"name": "move_joints", "arguments": json.dumps(given)}
        call = {"id": f"c{calls}", "type": "function", "function": function}
        message = {"role": "assistant", "content": None, "tool_calls": [call]}
        return httpx.Response(200, json={"choices": [{"message": message}]})

    policy = import_module("inspect_robots_agent").LLMAgentPolicy(
        model="scripted",
        base_url="http://llm.invalid/v1",
        transport=httpx.MockTransport(answer),
        pre_check=arm.pre_check,
    )
    policy.bind(arm.info)
    policy.reset(import_module("inspect_robots.scene").Scene(id="one", instruction="turn"))
    home = np.array([*robot.home_rad, 1.0])
    state = {"joint_pos": home, "eef_pose": np.zeros(7)}
    observation = import_module("inspect_robots.types").Observation(state=state)
    chunk = policy.act(observation)
    gone_rad = float(chunk.actions[-1].data[1] - robot.home_rad[1])
    print(json.dumps({"heard": heard, "gone_rad": gone_rad}))


if __name__ == "__main__":
    main()
