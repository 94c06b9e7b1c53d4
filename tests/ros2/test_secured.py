"""A secured lab of two hosts whose robot speaks ROS 2, with the real bridge and real certificates.

Both hosts are this computer. Each has a folder of certificates with its own and no others.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint
from chain import running_chain
from vla_zenoh_ros2.keys import Endpoint, EntityRole, Ros2Dds

if TYPE_CHECKING:
    from rig import Lab

ros = pytest.importorskip("ros_messages", exc_type=ImportError)

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

STEPS, STEP_M, WAY_TOLERANCE_M = 5, 0.01, 0.002
COMMAND_S, END_S, CALL_S = 60.0, 10.0, 10.0
LOOK_S = 1.0
"""For so long somebody who may not, tries."""
TOKENS = "@/*/@ros2_lv/**"
PLAIN = """\
extends: panda_ros2
cameras:
  front: {{width: 80, height: 60, rate_hz: 20, check: {{same_s: 0}}}}
  wrist: null
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session:
  listen: ["{ours}"]
  connect: ["{ours}"]
ros2:
  domain: {domain}
  services: true
  connect: ["{theirs}"]
  cameras: {{wrist: null}}
hosts:
  robot: {{nodes: [router, ros2, command]}}
  gpu: {{nodes: [worker]}}
timing: {{command_hz: 100, state_hz: 100}}
"""
BY_TLS = """\
extends: plain_secure
ros2: {{connect: ["{theirs}"]}}
"""
ON_HOST = """\
extends: {lab}
session: {{security: {{folder: {folder}}}}}
"""


def command(folder: Path, *words: str) -> str:
    """What a command of ours prints on stdout."""
    done = subprocess.run(
        [sys.executable, "-m", "vla_zenoh", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=COMMAND_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextmanager
def up(profile: Path, host: str) -> Iterator[None]:
    """Another host of the lab, as a process."""
    with (profile.parent / f"{host}.log").open("w") as log:
        words = [sys.executable, "-m", "vla_zenoh", "up", str(profile), "--host", host]
        process = subprocess.Popen(words, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(END_S)
            finally:
                process.kill()


@dataclass
class SecuredLab:
    """What a test holds.

    Args:
        lab: of the robot's host.
        bridge_at: where the bridge listens.
        certificates: folder of each host, with its certificates alone.
    """

    lab: Lab
    bridge_at: str
    certificates: dict[str, Path]


@contextmanager
def running(folder: Path, program: Path, protocol: str) -> Iterator[SecuredLab]:
    """Made by the commands of docs/how-to/ros2.md; `protocol` is how the bridge is reached."""
    from bridge import Bridge
    from rig import HEIGHT, STATE_HZ, WIDTH, Lab, Robot
    from ros_node import free_domain
    from witness import Witness

    domain, ours, theirs = free_domain(), free_endpoint(), free_endpoint()
    file = folder / "plain.yaml"
    file.write_text(PLAIN.format(ours=ours, theirs=theirs, domain=domain))
    store = folder / "certificates"
    command(folder, "secure", "init", "--profile", "./plain.yaml", "--folder", str(store))
    lab = "plain_secure"
    if protocol == "tls":
        theirs = theirs.replace("tcp/", "tls/")
        (folder / "by_tls.yaml").write_text(BY_TLS.format(theirs=theirs))
        lab = "by_tls"
        command(folder, "secure", "add", "robot", "--renew", "--profile", f"./{lab}.yaml")
    settings = command(folder, "profile", "bridge-config", "--profile", f"./{lab}.yaml")
    certificates = {}
    for host in ("robot", "gpu"):
        own = certificates[host] = folder / f"of_{host}"
        shutil.copytree(store / host, own / host)
        (folder / f"on_{host}.yaml").write_text(ON_HOST.format(lab=lab, folder=own))
    with ExitStack() as stack:
        bridge = Bridge(program, folder, settings).start()
        stack.callback(bridge.kill)
        pictures = ("--width", str(WIDTH), "--height", str(HEIGHT), "--camera-hz", "20")
        robot = Robot(domain, "--camera", "front", "--state-hz", str(STATE_HZ), *pictures)
        stack.callback(robot.end)
        witness = Witness(domain)
        stack.callback(witness.close)
        on_robot = folder / "on_robot.yaml"
        chain = stack.enter_context(running_chain(folder, profile_file=on_robot, host="robot"))
        stack.enter_context(up(folder / "on_gpu.yaml", "gpu"))
        chain.recorder.only = {"state": "ros2#", "command": "command#"}
        held = Lab(domain, robot, bridge, witness, chain)
        yield SecuredLab(held, theirs, certificates)


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_secured_robot_moves_by_a_model_on_another_host_and_nobody_else_moves_it(
    tmp_path: Path, bridge_program: Path, protocol: str
) -> None:
    with running(tmp_path, bridge_program, protocol) as secured:
        lab = secured.lab
        lab.chain.activate_when_ready()
        began_m = lab.activate_at_rest()
        lab.chain.go("up", STEPS)
        way_m = lab.witness.wait_still() - began_m
        assert way_m == pytest.approx((0, 0, STEPS * STEP_M), abs=WAY_TOLERANCE_M)
        set_prompt = lab.witness.node.client(
            "/vla/set_prompt", ros.SetPromptRequest, ros.SetPromptResponse
        )
        assert set_prompt.call("HARD: close gripper x1", timeout_s=CALL_S).success
        lab.chain.until("the fingers close", lambda: lab.witness.width_m() < 0.06)
        if protocol == "tls":
            nobody_else_moves_it(secured)


def nobody_else_moves_it(secured: SecuredLab) -> None:
    """Nobody gets in without a certificate of the lab; by another's than ros2 nothing passes."""
    lab = secured.lab
    lab.chain.settle()
    stood_m = lab.witness.wait_still()
    with pytest.raises(zenoh.ZError):
        zenoh.open(settings(secured, "gpu", None))
    assert not any(heard_by(secured, "gpu", "worker-scripted"))
    assert not any(heard_by(secured, "robot", "command"))
    assert not goes_through(secured, "gpu", "worker-scripted")
    assert not goes_through(secured, "robot", "operator")
    assert np.linalg.norm(lab.witness.position_m() - stood_m) < WAY_TOLERANCE_M
    # What was tried in vain is no mistake in how it was tried.
    assert all(heard_by(secured, "robot", "ros2"))
    assert goes_through(secured, "robot", "ros2")


def heard_by(secured: SecuredLab, host: str, node: str) -> tuple[bool, bool]:
    """Whether somebody with this certificate hears joint states, and who is on the ROS graph."""
    states: list[Any] = []
    with zenoh.open(settings(secured, host, node)) as session:
        wire = Ros2Dds(str(session.zid()), None)
        mine = session.liveliness().declare_token(wire.node_token())
        end = Endpoint(EntityRole.SUBSCRIBER, "/joint_states", "sensor_msgs/msg/JointState")
        handler = zenoh.handlers.Callback(states.append, indirect=False)
        subscriber = session.declare_subscriber(wire.key(end), handler)
        give_up = time.monotonic() + LOOK_S
        while not states and time.monotonic() < give_up:
            time.sleep(0.02)
        replies = session.liveliness().get(TOKENS)
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        others = [key for key in keys if key != wire.node_token()]
        subscriber.undeclare()
        mine.undeclare()
    return bool(states), bool(others)


def goes_through(secured: SecuredLab, host: str, node: str) -> bool:
    """Whether what somebody with this certificate puts reaches the node ``ros2``, by the bridge."""
    key = f"{uuid.uuid4().hex}/said"
    heard: list[Any] = []
    with (
        zenoh.open(settings(secured, "robot", "ros2")) as listener,
        zenoh.open(settings(secured, host, node)) as session,
    ):
        handler = zenoh.handlers.Callback(heard.append, indirect=False)
        subscriber = listener.declare_subscriber(key, handler)
        give_up = time.monotonic() + LOOK_S
        while not heard and time.monotonic() < give_up:
            session.put(key, b"go")
            time.sleep(0.02)
        subscriber.undeclare()
    return bool(heard)


def settings(secured: SecuredLab, host: str, node: str | None) -> zenoh.Config:
    """Of a session to the bridge that shows the certificate of a node, or none."""
    folder = secured.certificates[host] / host
    tls: dict[str, Any] = {"root_ca_certificate": str(folder / "ca.pem")}
    if node is not None:
        tls |= {
            "enable_mtls": True,
            "connect_certificate": str(folder / f"{node}.pem"),
            "connect_private_key": str(folder / f"{node}.key"),
        }
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{secured.bridge_at}"]')
    config.insert_json5("connect/timeout_ms", "3000")
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, value in tls.items():
        config.insert_json5(f"transport/link/tls/{name}", _json5(value))
    return config


def _json5(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"'
