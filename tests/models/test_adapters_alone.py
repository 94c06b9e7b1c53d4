"""Each adapter in the environment its header asks for, which has nothing else of ours."""

from __future__ import annotations

import json
import subprocess

import pytest
from peer_rig import free_port

from vla_zenoh.policy.loader import find_model
from vla_zenoh.runtime.environments import environment_command

pytestmark = [pytest.mark.models, pytest.mark.timeout(300)]

MADE_S = 280.0
"""uv fetches a hundred megabytes at the first time."""
CODE = """
import importlib.util, json, sys
from vla_zenoh.errors import PeerError
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.lab.check.examples import example_observation

policy = make_policy(find_model(sys.argv[1]), json.loads(sys.argv[2]))
policy.load()
observation = example_observation(policy.spec)
policy.mapping.request(observation)
try:
    policy.infer(observation)
except PeerError as error:
    joints = importlib.util.find_spec("pinocchio") is not None
    print(json.dumps([error.reason, joints]))
"""
OPTIONS = {
    # adapter: (options, where its server is not, whether it needs the arm's kinematics)
    "openpi": ({"preset": "droid"}, "ws://127.0.0.1:PORT", True),
    "groot": ({"preset": "libero"}, "tcp://127.0.0.1:PORT", True),
    "openvla_rest": ({"preset": "oft_libero"}, "http://127.0.0.1:PORT", False),
    "origami": ({"dt_s": "0.1"}, "tcp/127.0.0.1:PORT", True),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_an_adapter_asks_its_server_from_an_environment_of_its_own(name: str) -> None:
    options, url, kinematics = OPTIONS[name]
    told = json.dumps({**options, "url": url.replace("PORT", str(free_port())), "timeout_s": "1"})
    command = [*environment_command(find_model(name)), "python", "-c", CODE, name, told]
    done = subprocess.run(command, capture_output=True, text=True, timeout=MADE_S, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == ["peer_gone", kinematics]
