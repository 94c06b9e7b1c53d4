"""The adapters against servers that speak as published, each a process of its own."""

from __future__ import annotations

import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from peer_rig import (
    ADAPTERS,
    JSON_NUMPY,
    KINDS,
    MSGPACK_NUMPY,
    OPENPI_CLIENT,
    Server,
    free_port,
    of,
    python_with,
    reachable,
    served,
)

from vla_zenoh.errors import PeerError, SpecError, WorkerError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation, Policy, check_steps
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import JointState

pytestmark = pytest.mark.realtime
STEP_M, ATOL_M = 0.01, 1e-6
FK_ATOL_M = 1e-3
TIMEOUT_S = 1.0
LATE_S = 0.6
"""What a busy machine may add to a time-out."""
PATIENCE_S = 8.0
BACK_OFF_S = 2.0
UP_RAD = 0.03
LIBERO = {"preset": "libero"}
LEROBOT = {**LIBERO, "horizon": "8"}
LEROBOT_ACT = {**LEROBOT, "policy": "act", "checkpoint": "x"}
XPOLICYLAB = {"preset": "pose", "gripper": "absolute_m", "dt_s": "0.1", "horizon": "8"}
JOINTS = {
    **{"action": "joint_delta", "anchor": "goal", "relative_to": "previous"},
    **{"joint_scale_rad": "1", "gripper": "none", "dt_s": "0.1"},
}


@contextmanager
def made(model: str, settings: Mapping[str, str]) -> Iterator[Policy]:
    policy = make_policy(find_model(model), settings)
    getattr(policy, "load", lambda: None)()
    try:
        yield policy
    finally:
        getattr(policy, "close", lambda: None)()


@contextmanager
def asked(
    name: str, *, python: str = sys.executable, **options: str
) -> Iterator[tuple[Server, Policy]]:
    """A server and the adapter that asks it."""
    with (
        reachable(KINDS[name], python=python) as server,
        made(server.kind.model, {**server.settings, **options}) as policy,
    ):
        yield server, policy


def seen(policy: Policy, prompt: str) -> Observation:
    found = example_observation(policy.spec, prompt=prompt)
    if found.joint is None:
        return found
    robot = load_profile("panda_sim").robot
    none = np.zeros(7)
    return replace(found, joint=JointState(robot.arm_joints, robot.home_rad, none, none))


def answer(policy: Policy, prompt: str, patience_s: float = PATIENCE_S) -> np.ndarray[Any, Any]:
    """Checked steps, asked for again and again while the server is not there."""
    give_up_s = time.monotonic() + patience_s
    while True:
        try:
            return check_steps(policy.spec.action, policy.infer(seen(policy, prompt)).steps)
        except PeerError as error:
            if error.reason not in ("peer_gone", "peer_timeout") or time.monotonic() > give_up_s:
                raise
        time.sleep(0.02)


def refusal(policy: Policy, prompt: str) -> PeerError:
    """How the next question that reaches the server is refused, and that it takes no time."""
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        began_s = time.monotonic()
        with pytest.raises(PeerError) as raised:
            policy.infer(seen(policy, prompt))
        assert time.monotonic() - began_s < 2 * TIMEOUT_S + LATE_S
        if "retrying" not in str(raised.value) or time.monotonic() > give_up_s:
            return raised.value
        time.sleep(0.02)


def height_m(policy: Policy, steps: np.ndarray[Any, Any]) -> float:
    """How far the first step goes up; with joints, from those of `hold`."""
    action = policy.spec.action
    if action.space == "tcp":
        return float(steps[0, 2])
    profile = load_profile("panda_sim")
    kinematics = make_kinematics(profile)
    here_rad = np.array(profile.robot.home_rad) * (action.kind == "delta")
    still = here_rad + answer(policy, "hold")[0, : action.arm_size]
    up, home = (
        kinematics.forward(kinematics.ordered(action.joints, joints)).position_m[2]
        for joints in (here_rad + steps[0, : action.arm_size], still)
    )
    return float(up - home)


@pytest.mark.parametrize("name", of(*KINDS, quick=ADAPTERS))
def test_an_adapter_and_its_server_understand_each_other_and_recover_from_every_fault(
    name: str,
) -> None:
    with asked(name) as (_, policy):
        up, down, still = (answer(policy, prompt) for prompt in ("up", "down", "hold"))
        if policy.spec.action.space == "tcp":
            assert height_m(policy, up) == pytest.approx(STEP_M, abs=ATOL_M)
            assert height_m(policy, down) == pytest.approx(-STEP_M, abs=ATOL_M)
            assert np.abs(still[:, :6]).max() < ATOL_M
            assert (up[:, 6] == 1.0).all()
            assert policy.spec.action.gripper_open_is_high
        else:
            # The second joint turned back by UP_RAD moves the hand on a circle about it.
            assert height_m(policy, up) == pytest.approx(-height_m(policy, down), abs=FK_ATOL_M)
            assert height_m(policy, up) > 0.2 * UP_RAD
        for fault, reason in (
            ("nan", "peer_reply"),
            ("short", "peer_reply"),
            ("raise", "peer_error"),
        ):
            assert refusal(policy, f"up {fault}").reason == reason, fault
            np.testing.assert_allclose(answer(policy, "up"), up, atol=ATOL_M)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "packages"),
    [("openpi", OPENPI_CLIENT), ("vllm", OPENPI_CLIENT)]
    + [(name, JSON_NUMPY) for name in ("openvla_rest", "openvla_text", "oft")]
    + [("xpolicylab", MSGPACK_NUMPY)],
)
def test_a_server_that_encodes_by_the_peers_own_package_is_understood(
    name: str, packages: tuple[str, ...]
) -> None:
    with asked(name, python=python_with(*packages)) as (_, policy):
        moved_m = height_m(policy, answer(policy, "up"))
        if policy.spec.action.space == "tcp":
            assert moved_m == pytest.approx(STEP_M, abs=ATOL_M)
        else:
            assert moved_m > 0.2 * UP_RAD
        assert refusal(policy, "up raise").reason == "peer_error"


@pytest.mark.parametrize("name", of(*ADAPTERS, "groot_n15", quick=("groot",)))
def test_a_late_answer_is_never_taken_for_that_of_the_next_question(name: str) -> None:
    with asked(name, timeout_s="0.4") as (_, policy):
        up = answer(policy, "up")
        with pytest.raises(PeerError) as raised:
            policy.infer(seen(policy, "down slow"))
        assert raised.value.reason == "peer_timeout"
        # The answer to that one arrives while these are asked.
        give_up_s = time.monotonic() + 2.5
        while time.monotonic() < give_up_s:
            try:
                got = policy.infer(seen(policy, "up")).steps
            except PeerError:
                time.sleep(0.02)
                continue
            np.testing.assert_allclose(np.asarray(got), up, atol=ATOL_M)
            time.sleep(0.05)
        np.testing.assert_allclose(answer(policy, "up"), up, atol=ATOL_M)


@pytest.mark.parametrize("name", of(*ADAPTERS, quick=()))
def test_a_server_killed_and_started_again_is_found(name: str) -> None:
    with asked(name) as (server, policy):
        answer(policy, "up")
        server.kill()
        error = refusal(policy, "up")
        assert error.reason in ("peer_gone", "peer_timeout")
        server.start()
        answer(policy, "up")


@pytest.mark.parametrize("name", of(*ADAPTERS, quick=("openpi",)))
def test_a_stopped_server_takes_no_more_than_the_time_out(name: str) -> None:
    with asked(name) as (server, policy):
        answer(policy, "up")
        server.signal(signal.SIGSTOP)
        try:
            reasons = [refusal(policy, "up").reason for _ in range(2)]
        finally:
            server.signal(signal.SIGCONT)
        assert "peer_timeout" in reasons
        assert set(reasons) <= {"peer_timeout", "peer_gone"}
        answer(policy, "up")


@pytest.mark.parametrize("name", of(*ADAPTERS))
def test_without_a_server_the_answer_is_that_nobody_is_there(name: str) -> None:
    kind = KINDS[name]
    settings = {**kind.settings(free_port()), "timeout_s": "0.3"}
    with made(kind.model, settings) as policy:
        for _ in range(3):
            assert refusal(policy, "up").reason == "peer_gone"


@pytest.mark.parametrize("name", of(*(name for name in ADAPTERS if name != "origami")))
def test_a_port_that_accepts_and_says_nothing_takes_no_more_than_the_time_out(name: str) -> None:
    kind = KINDS[name]
    with socket.create_server(("127.0.0.1", 0)) as mute:
        settings = {**kind.settings(mute.getsockname()[1]), "timeout_s": "0.3"}
        with made(kind.model, settings) as policy:
            began_s = time.monotonic()
            assert refusal(policy, "up").reason in ("peer_timeout", "peer_gone")
            assert time.monotonic() - began_s < 0.6 + LATE_S


def test_a_server_that_gives_a_byte_now_and_then_takes_no_more_than_the_time_out() -> None:
    kind = KINDS["openvla_rest"]
    ends = threading.Event()

    def drip(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection:
            head = b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n"
            for byte in head + b"[" * 1000:
                if ends.wait(0.01):
                    return
                try:
                    connection.send(bytes([byte]))
                except OSError:
                    return

    with socket.create_server(("127.0.0.1", 0)) as slow:
        thread = threading.Thread(target=drip, args=(slow,))
        thread.start()
        settings = {**kind.settings(slow.getsockname()[1]), "timeout_s": "0.3"}
        policy = make_policy(find_model(kind.model), settings)
        began_s = time.monotonic()
        error = refusal(policy, "up")
        took_s = time.monotonic() - began_s
        ends.set()
        thread.join(5)
    assert error.reason == "peer_timeout"
    assert took_s < 0.3 + LATE_S


def test_a_connection_that_the_server_closed_while_idle_is_made_again_without_a_refusal() -> None:
    with asked("openpi") as (server, policy):
        answer(policy, "up")
        server.kill()
        server.start()
        time.sleep(0.1)
        answer(policy, "up", patience_s=0.0)


NEEDS_GRPC = pytest.mark.skipif(find_spec("grpc") is None, reason="there is no grpcio")


@NEEDS_GRPC
@pytest.mark.parametrize(
    ("variant", "named"),
    [
        ("pickle", "names 'posix.system', which is not allowed and was not run"),
        ("other", "it is that of another observation"),
    ],
)
def test_an_answer_of_lerobots_server_that_is_none_is_refused(
    variant: str, named: str, capfd: pytest.CaptureFixture[str]
) -> None:
    kind = replace(KINDS["lerobot_server"], variant=variant)
    with served(kind) as server, made("lerobot_server", server.settings) as policy:
        error = refusal(policy, "up")
    assert (error.reason, named in str(error)) == ("peer_reply", True), error
    assert "has run" not in capfd.readouterr().out


@NEEDS_GRPC
def test_a_server_that_loads_longer_than_an_answer_may_take_is_waited_for() -> None:
    kind = replace(KINDS["lerobot_server"], variant="slow")
    with served(kind) as server, made("lerobot_server", server.settings) as policy:
        error = refusal(policy, "up")
        assert (error.reason, "loads the policy" in str(error)) == ("peer_timeout", True), error
        answer(policy, "up")
        # Nothing but a new server loads it again.
        with pytest.raises(PeerError, match="gave no actions"):
            policy.infer(seen(policy, "up raise"))
        answer(policy, "up", patience_s=1.0)


@NEEDS_GRPC
def test_what_lerobots_server_says_of_a_policy_that_it_cannot_load_is_told() -> None:
    with served(KINDS["lerobot_server"]) as server:
        settings = {**server.settings, "checkpoint": "nowhere"}
        with made("lerobot_server", settings) as policy:
            error = refusal(policy, "up")
    assert (error.reason, "no such policy: nowhere" in str(error)) == ("peer_error", True), error


def test_groots_pickles_are_refused() -> None:
    kind = replace(KINDS["groot"], variant="pickle")
    with served(kind) as server, made("groot", server.settings) as policy:
        assert "pickles, which run code" in str(refusal(policy, "up"))


@pytest.mark.parametrize(
    ("name", "number"), [("origami", "request_id"), ("xpolicylab", "message_id")]
)
def test_an_answer_with_another_questions_number_is_refused(name: str, number: str) -> None:
    with (
        reachable(replace(KINDS[name], variant="other")) as server,
        made(name, server.settings) as policy,
    ):
        until_s = time.monotonic() + PATIENCE_S
        while (error := refusal(policy, "up")).reason == "peer_gone":
            assert time.monotonic() < until_s
        assert f"{number} of the answer is 'another'" in str(error)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("vllm", {"columns": "0:8"}, "column 7 is wanted"),
        ("groot", {"map": "video.image=, video.top=camera:front"}, "wants video image"),
        ("groot", {"keys": "x,y,z,roll,pitch,yaw,grip"}, "gives no action grip"),
        pytest.param("groot_n15", {"map": "state.x="}, "wants state x", marks=pytest.mark.slow),
        pytest.param(
            "origami",
            JOINTS,
            "action=joint_delta is set",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_the_server_says_of_itself_is_held_against_the_options(
    name: str, options: dict[str, str], named: str
) -> None:
    kind = KINDS[name]
    given = kind.options.get("map", "")
    if "map" in options:
        options = {**options, "map": f"{given}, {options['map']}"}
    with asked(name, **options) as (_, policy):
        error = refusal(policy, "up")
        while error.reason == "peer_gone":
            error = refusal(policy, "up")
        assert error.reason == "peer_mismatch"
        assert named in str(error)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("openpi", {"url": "http://127.0.0.1:1"}, "ws://HOST:PORT"),
        ("openpi", {}, "preset is '', allowed: libero, droid, own, none"),
        ("groot", {}, "preset is '', allowed: libero, bridge, none"),
        ("openvla_rest", {}, "preset is '', allowed: bridge, libero, oft_libero, none"),
        ("openpi", {"preset": "none"}, "map is empty"),
        ("openpi", {"preset": "none", "map": "a=prompt"}, r"--set action=\(delta or absolute"),
        ("openpi", {**LIBERO, "dialect": "latin"}, "auto, openpi, vllm"),
        ("openpi", {**LIBERO, "timeout_s": "0"}, "0.01 to 60"),
        ("openpi", {**LIBERO, "sise": "224x224"}, "no option 'sise'"),
        ("groot", {**LIBERO, "version": "n1"}, "n1.5, n1.6"),
        ("groot", {**LIBERO, "map": "image=camera:front"}, "must begin with 'video.'"),
        ("openvla_rest", {**LIBERO, **JOINTS}, "joints are not read"),
        ("openvla_rest", {"url": "ftp://x"}, "http://HOST:PORT"),
        ("openvla_rest", {**LIBERO, "encoded": "perhaps"}, "yes, no"),
        ("origami", {"session_id": ""}, "session_id is empty"),
        ("lerobot_server", {}, "preset is '', allowed: libero, none"),
        ("lerobot_server", LEROBOT, r"policy is '', allowed: act, diffusion"),
        ("lerobot_server", {**LEROBOT, "policy": "act"}, "checkpoint is empty"),
        (
            "lerobot_server",
            {**LEROBOT, "policy": "act", "checkpoint": "x", "load_s": "0"},
            "load_s",
        ),
        ("lerobot_server", {**LEROBOT_ACT, "map": "image=camera:front"}, "'image' is not read by"),
        (
            "lerobot_server",
            {**LEROBOT_ACT, "map": "observation.state="},
            "observation.state is mis",
        ),
        ("lerobot_server", {"preset": "libero"}, "--set horizon="),
        ("xpolicylab", {}, "preset is '', allowed: joint, pose, none"),
        ("xpolicylab", XPOLICYLAB, "--set map=state/ee_joint_state="),
        ("xpolicylab", {**XPOLICYLAB, "map": "vision=prompt"}, "'vision' is no value of its own"),
        ("xpolicylab", {**XPOLICYLAB, "map": "state/=joint"}, "'state/' is no value of its own"),
        ("xpolicylab", {"preset": "pose", "dt_s": "0.1"}, r"--set gripper=.*--set horizon="),
        ("xpolicylab", {"preset": "joint", "dt_s": "0.1"}, r"--set joint_scale_rad="),
    ],
)
def test_an_option_that_cannot_be_is_refused_before_anything_runs(
    name: str, options: dict[str, str], named: str
) -> None:
    with pytest.raises(WorkerError, match=named) as raised:
        make_policy(find_model(name), options)
    assert isinstance(raised.value.__cause__, SpecError)


def test_a_servers_statistics_are_part_of_the_spec() -> None:
    policy = make_policy(
        find_model("openvla_rest"), {"preset": "bridge", "unnorm_key": "bridge_orig"}
    )
    assert policy.spec.action.normalisation == "bridge_orig"
