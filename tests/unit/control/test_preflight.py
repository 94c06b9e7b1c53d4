"""Every reason not to activate, and all of them at once."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from command_rig import MS, OFTEN, START_NS, WORKER, Rig, model_spec, profile

from vla_zenoh.control.limits import BEGIN_M
from vla_zenoh.control.policy_check import spec_errors, wrong_rate
from vla_zenoh.control.preflight import (
    SETTLED,
    SETTLED_NS,
    Passing,
    PeerSnapshot,
    Settling,
    reasons_of_part,
    reasons_of_worker,
)
from vla_zenoh.keys import LOADING, NOTHING_YET, OPENING
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import pose_of
from vla_zenoh.lab.check.fit import check_spec
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, Header, JointState, PoseState, Stamped


class Ready:
    """Everything as it has to be; a test breaks one thing."""

    def __init__(self) -> None:
        rig = Rig(profile(timing=OFTEN))
        self.profile, self.peers = rig.profile, rig.peers
        self.worker, self.prompt, self.rate_hz = WORKER, "hold", 5.0
        self.pose, self.gripper = rig.pose_state(), rig.gripper_state()
        self.chunk = rig.chunk([[0.0] * 7], observed_ago_s=0.05)
        self.now_ns = self.chunk.received_ns

    def reasons(self) -> list[str]:
        now_ns, peers = self.now_ns, self.peers
        return [
            *reasons_of_part(self.profile, peers, self.pose, self.gripper, now_ns),
            *reasons_of_worker(
                self.profile, self.worker, self.prompt, peers, self.chunk, now_ns, self.rate_hz
            ),
        ]


GUESSED = ("robot.home_rad", "limits.joint.jerk_rad_s3")


def test_a_real_arm_is_not_activated_while_a_guess_is_unconfirmed() -> None:
    ready = Ready()
    real = override(load_profile("ur5e_rtde"), {"unconfirmed": GUESSED})
    reasons = reasons_of_part(real, ready.peers, ready.pose, ready.gripper, ready.now_ns)
    assert (
        "guessed and not confirmed: robot.home_rad, limits.joint.jerk_rad_s3; look at each in the "
        "profile, correct it, and delete it from unconfirmed"
    ) in reasons
    confirmed = override(real, {"unconfirmed": ()})
    left = reasons_of_part(confirmed, ready.peers, ready.pose, ready.gripper, ready.now_ns)
    assert left == reasons[1:]


def test_a_simulated_arm_is_activated_with_guesses() -> None:
    ready = Ready()
    ready.profile = override(ready.profile, {"unconfirmed": GUESSED})
    assert ready.reasons() == []


def without(peers: PeerSnapshot, *nodes: str) -> PeerSnapshot:
    return replace(peers, alive=peers.alive - set(nodes))


def pose_at(x: float) -> Stamped[PoseState]:
    record = PoseState(np.array([x, 0.0, 0.3]), np.array([1.0, 0, 0, 0]), np.zeros(6))
    return Stamped(Header(START_NS, 0, "sim-1"), record, START_NS)


def gripper_that(**fields: object) -> Stamped[GripperState]:
    record = GripperState(0.08, moving=False, holding=False, **fields)  # pyright: ignore
    return Stamped(Header(START_NS, 0, "sim-1"), record, START_NS)


def seen_ago(ready: Ready, seconds: float) -> None:
    stamp_ns = ready.chunk.received_ns - round(seconds * 1e9)
    record = replace(ready.chunk.record, observation_stamp_ns=stamp_ns)
    ready.chunk = replace(ready.chunk, record=record)


def set_(name: str, value: object) -> Callable[[Ready], None]:
    return lambda ready: setattr(ready, name, value)


def peers(**fields: object) -> Callable[[Ready], None]:
    def change(ready: Ready) -> None:
        ready.peers = replace(ready.peers, **fields)  # pyright: ignore[reportArgumentType]

    return change


def gone(*nodes: str) -> Callable[[Ready], None]:
    def change(ready: Ready) -> None:
        ready.peers = without(ready.peers, *nodes)

    return change


def later(seconds: float) -> Callable[[Ready], None]:
    def change(ready: Ready) -> None:
        ready.now_ns += round(seconds * 1e9)

    return change


def another_chunk(**fields: object) -> Callable[[Ready], None]:
    def change(ready: Ready) -> None:
        record = replace(ready.chunk.record, **fields)  # pyright: ignore[reportArgumentType]
        ready.chunk = replace(ready.chunk, record=record)

    return change


def by_another_source(ready: Ready) -> None:
    header = replace(ready.chunk.header, source="worker-scripted-before")
    ready.chunk = replace(ready.chunk, header=header)


def clocks_apart(ready: Ready) -> None:
    header = replace(ready.pose.header, stamp_wall_ns=ready.pose.received_ns - 900 * MS)
    ready.pose = replace(ready.pose, header=header)


def clock(node: str, offset: tuple[float, float]) -> Callable[[Ready], None]:
    return peers(clocks={node: offset})


def test_when_all_is_well_there_is_no_reason() -> None:
    assert Ready().reasons() == []


@pytest.mark.parametrize(
    ("match", "change"),
    [
        ("the robot's node 'sim' is not alive", gone("sim")),
        ("the TCP pose is not known", set_("pose", None)),
        (r"the TCP pose is 0\.20 s old, at most 0\.15 s", later(0.196)),
        (r"robot state lost: gripper 0\.\d+ s old, at most 0\.15 s", later(0.196)),
        (r"the robot's clock and this one differ: .* \+0\.900 s", clocks_apart),
        (
            r"the TCP at \(0\.100, 0\.000, 0\.300\) m is 0\.100 m outside",
            set_("pose", pose_at(0.1)),
        ),
        ("the gripper is not known", set_("gripper", None)),
        ("the robot reports: hot; sore", set_("gripper", gripper_that(faults=("hot", "sore")))),
        ("the robot is not ready but 'braking'", set_("gripper", gripper_that(mode="braking"))),
        ("worker 'scripted' is not alive; alive are: other", gone("worker-scripted")),
        ("alive are: none", gone("worker-scripted", "worker-other")),
        ("worker 'ghost' is not alive", set_("worker", "ghost")),
        ("has not published its spec", peers(specs={})),
        ("needs a prompt and there is none", set_("prompt", "")),
        ("worker 'scripted' reports: no sun", peers(worker_complaints={WORKER: "no sun"})),
        ("has published no chunk in the last 2.2 s", set_("chunk", None)),
        ("has published no chunk in the last 2.2 s", later(2.3)),
        ("has published no chunk", by_another_source),
        ("has published no chunk", peers(spec_sources={})),
        ("chunks of another spec than its own", another_chunk(spec_hash="another")),
        (r"newest chunk is not sane: .*\(H, 7\)", another_chunk(steps=np.zeros((1, 6)))),
        (r"too slow: .* 1\.20 s after its observation, at most 1 s", lambda r: seen_ago(r, 1.2)),
        (r"saw something 0\.500 s before it happened", lambda r: seen_ago(r, -0.5)),
        (
            r"newest chunk is not sane: position_units: a step of 10 m, over 4 times",
            another_chunk(steps=np.array([[10.0, 0, 0, 0, 0, 0, 0]])),
        ),
        (
            r"newest chunk is not sane: rotation_units: a step of 2\.865 rad",
            another_chunk(steps=np.array([[0, 0, 0, 2.865, 0, 0, 0]])),
        ),
        (
            r"newest chunk is not sane: gripper_range: gripper 80",
            another_chunk(steps=np.array([[0, 0, 0, 0, 0, 0, 80.0]])),
        ),
        ("camera 'front': its node 'camera' is not alive; `vla-zenoh up` on its", gone("camera")),
        (
            "worker 'scripted' is not alive: crashed 6 times: weights.pt not found; alive",
            peers(
                alive=frozenset({"sim", "camera"}),
                down={"worker-scripted": "crashed 6 times: weights.pt not found"},
            ),
        ),
        (
            "camera 'front' has sent no image for 1.5 s: it gives no reason",
            peers(camera_ages_s={"front": 1.5}),
        ),
        (
            "camera 'front' has sent no image yet: there is no /dev/video0",
            peers(
                camera_ages_s={},
                camera_nodes={},
                camera_reasons={"front": "there is no /dev/video0"},
            ),
        ),
        (
            r"camera 'front' shows the same picture since 1\.2 s",
            peers(camera_faults={"front": "shows the same picture since 1.2 s"}),
        ),
        (
            r"the clock of node 'camera' is \+0\.150 s off",
            clock("camera", (0.15, 0.1)),
        ),
        (r"the clock of node 'sim' is -0\.101 s off", clock("sim", (-0.101, 0.05))),
        (
            "the clock of node 'worker-scripted' on gpu is not known",
            peers(hosts={"worker-scripted": "gpu"}, same_host=frozenset({"sim", "camera"})),
        ),
        # Whoever has not said yet where it is may be anywhere.
        ("the clock of node 'sim' is not known", peers(same_host=frozenset())),
    ],
)
def test_each_thing_that_is_missing_is_a_reason(
    match: str, change: Callable[[Ready], None]
) -> None:
    ready = Ready()
    change(ready)
    assert any(re.search(match, reason) for reason in ready.reasons()), ready.reasons()


def test_a_clock_that_is_reckoned_with_is_no_reason() -> None:
    ready = Ready()
    clock("camera", (0.099, 0.3))(ready)
    assert ready.reasons() == []


@pytest.mark.parametrize("offset_s", [-0.5, -0.138, 0.0, 0.099, 0.101, 0.138, 0.5])
@pytest.mark.parametrize("uncertainty_s", [0.0, 0.02, 0.1385, 1.0])
@pytest.mark.parametrize("node", ["camera", "sim", "worker-scripted"])
def test_an_offset_within_its_own_uncertainty_is_none(
    node: str, offset_s: float, uncertainty_s: float
) -> None:
    ready = Ready()
    clock(node, (offset_s, uncertainty_s))(ready)
    wrong = abs(offset_s) > max(uncertainty_s, ready.profile.timing.max_clock_offset_s)
    assert bool(ready.reasons()) is wrong, ready.reasons()


def test_a_state_of_another_host_may_be_early_by_what_its_clock_is_uncertain() -> None:
    ready = Ready()
    header = replace(ready.pose.header, stamp_wall_ns=ready.pose.received_ns + 150 * MS)
    ready.pose = replace(ready.pose, header=header)
    assert any("clock" in reason for reason in ready.reasons())
    others = ready.peers.same_host - {"sim"}
    peers(same_host=others, clocks={"sim": (0.1, 0.2)})(ready)
    assert ready.reasons() == []


def test_a_clock_that_is_measured_need_not_be_our_own() -> None:
    ready = Ready()
    nodes = (*ready.peers.same_host, "camera")
    peers(same_host=frozenset(), clocks=dict.fromkeys(nodes, (0.0, 0.3)))(ready)
    assert ready.reasons() == []


def test_a_camera_the_profile_does_not_have_is_a_reason() -> None:
    ready = Ready()
    ready.profile = ready.profile.model_copy(update={"cameras": {}})
    assert ready.reasons() == [
        "worker 'scripted' needs camera 'front', the profile has: none; add it to cameras, or name "
        "another in the model's options"
    ]


def test_a_slow_rate_gives_the_worker_more_time() -> None:
    ready = Ready()
    ready.rate_hz = 0.05
    ready.now_ns += 20 * 10**9
    assert not any("no chunk" in reason for reason in ready.reasons())


@pytest.mark.parametrize(
    ("every_step", "dt_s", "rate_hz", "rejected"),
    [
        (True, 1 / 30, 5.0, True),
        (True, 1 / 30, 30.0, False),
        (True, 1 / 30, 29.0, False),
        (True, 0.1, 30.0, True),
        (False, 1 / 30, 5.0, False),
    ],
)
def test_a_model_that_counts_its_inferences_is_asked_once_a_step(
    every_step: bool, dt_s: float, rate_hz: float, rejected: bool
) -> None:
    """Else its history, or the mean of its chunks, has other times than in training."""
    spec = ModelSpec(
        name="act", action=ActionSpec(horizon=1, dt_s=dt_s, gripper="none"), every_step=every_step
    )
    profile, reason = load_profile("panda_sim"), wrong_rate(spec, rate_hz)
    assert bool(reason) == rejected
    found = check_spec(profile, spec, worker="scripted", rate_hz=rate_hz)
    assert [each.why for each in found if each.name == "rate"] == ([reason] if rejected else [])
    ready = Ready()
    ready.rate_hz = rate_hz
    ready.peers = replace(ready.peers, specs={WORKER: spec})
    assert (f"worker {WORKER!r}: {reason}" in ready.reasons()) == rejected
    if rejected:
        assert f"asked every {1 / rate_hz:.4g} s: set {1 / dt_s:.4g} chunks per second" in reason


def test_a_spec_without_such_a_count_has_the_form_of_before() -> None:
    spec = ModelSpec(name="act", action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"))
    assert "every_step" not in spec.to_dict()
    assert ModelSpec.from_dict({**spec.to_dict(), "every_step": True}).every_step


def test_all_reasons_come_at_once() -> None:
    ready = Ready()
    ready.pose = ready.gripper = ready.chunk = None  # pyright: ignore[reportAttributeAccessIssue]
    ready.prompt = ""
    ready.peers = without(ready.peers, "camera")
    assert len(ready.reasons()) == 5
    ready.peers = without(ready.peers, "sim")
    assert len(ready.reasons()) == 4, "a robot that is gone has no states: that is one reason"


def test_a_picture_of_a_size_the_spec_cannot_take_is_a_reason() -> None:
    ready = Ready()
    spec = ready.peers.specs[WORKER]
    small = CameraSpec(camera="front", width=64, height=48)
    looks = spec.observation.model_copy(update={"cameras": (small,)})
    spec = spec.model_copy(update={"observation": looks})
    record = replace(ready.chunk.record, spec_hash=spec.hash)
    ready.chunk = replace(ready.chunk, record=record)
    ready.peers = replace(ready.peers, specs={WORKER: spec})
    (reason,) = ready.reasons()
    assert re.search(r"picture_size: camera 'front' sends \d+x\d+, the spec asks for 64x48", reason)


@pytest.mark.parametrize(("rate_hz", "enough"), [(2.0, True), (1.9, False)])
def test_a_camera_may_be_as_slow_as_the_spec_allows_and_no_slower(
    rate_hz: float, enough: bool
) -> None:
    ready = Ready()
    spec = ready.peers.specs[WORKER]
    looks = spec.observation.model_copy(update={"max_age_s": 0.5})
    cameras = {"front": {"rate_hz": rate_hz}}
    slow = override(ready.profile, {"cameras": cameras})
    found = spec_errors(slow, spec.model_copy(update={"observation": looks}))
    assert [error.name for error in found] == [] if enough else ["camera_rate"]


def test_a_worker_that_needs_no_prompt_and_no_camera_gets_neither() -> None:
    ready = Ready()
    spec = model_spec()
    looks = spec.observation.model_copy(update={"cameras": (), "prompt": False})
    spec = spec.model_copy(update={"observation": looks})
    ready.peers = replace(without(ready.peers, "camera"), specs={WORKER: spec})
    another_chunk(spec_hash=spec.hash)(ready)
    ready.prompt = ""
    assert ready.reasons() == []


@pytest.mark.parametrize(
    "change",
    [
        set_("pose", None),
        set_("gripper", None),
        peers(specs={}),
        set_("chunk", None),
        peers(worker_complaints={WORKER: LOADING}),
        peers(worker_complaints={WORKER: f"{NOTHING_YET} of camera 'front'"}),
        peers(camera_ages_s={}, camera_nodes={}, camera_reasons={"front": OPENING}),
        peers(
            camera_ages_s={}, camera_nodes={}, camera_reasons={"front": f"{OPENING}: no scene yet"}
        ),
    ],
)
def test_what_is_starting_passes_by_itself(change: Callable[[Ready], None]) -> None:
    ready = Ready()
    change(ready)
    reasons = ready.reasons()
    assert reasons
    assert [why for why in reasons if not isinstance(why, Passing)] == []


@pytest.mark.parametrize(
    "change",
    [
        gone("sim"),
        set_("prompt", ""),
        peers(worker_complaints={WORKER: "no sun"}),
        later(2.3),
        peers(camera_ages_s={"front": 1.5}, camera_reasons={"front": OPENING}),
        peers(camera_ages_s={}, camera_nodes={}, camera_reasons={"front": "no /dev/video0"}),
    ],
)
def test_what_fails_does_not_pass_by_itself(change: Callable[[Ready], None]) -> None:
    ready = Ready()
    change(ready)
    assert [why for why in ready.reasons() if not isinstance(why, Passing)]


class Settles:
    """An arm whose stream stands, measured every 20 ms."""

    def __init__(self) -> None:
        self.settling = Settling(None)
        self.now_ns = START_NS
        self.state = replace(
            Ready().pose.record, reference_position_m=None, reference_quat_xyzw=None
        )

    def reasons(self, behind_m: float) -> list[str]:
        """Why it is not activated where it is so far behind its last command."""
        here_m = self.state.position_m - [behind_m, 0.0, 0.0]
        self.now_ns += 20 * MS
        self.settling.measure(replace(self.state, position_m=here_m), None, self.now_ns)
        return self.settling.unsettled(pose_of(self.state), None)

    def stand_ms(self, behind_m: float) -> int:
        """How long it stands until it is activated."""
        begin_ns = self.now_ns + 20 * MS
        while self.reasons(behind_m):
            assert self.now_ns < begin_ns + 10 * SETTLED_NS
        return (self.now_ns - begin_ns) // MS


def test_an_arm_that_still_moves_to_its_last_command_is_not_activated() -> None:
    arm = Settles()
    assert arm.settling.unsettled(pose_of(arm.state), None) == []
    for behind_m in np.arange(3 * BEGIN_M, BEGIN_M + SETTLED, -1.1 * SETTLED):
        (why,) = arm.reasons(behind_m)
        assert why.startswith(f"the robot is still {behind_m:.3f} m and 0.000 rad from its last")
    assert arm.reasons(0.9 * BEGIN_M) == []


def test_an_arm_that_stands_elsewhere_is_activated_there_after_a_while() -> None:
    arm = Settles()
    assert arm.reasons(2 * BEGIN_M)
    # It creeps, by less at a time than counts as motion.
    creeping = [arm.reasons(2 * BEGIN_M - step * 0.6 * SETTLED) for step in range(7)]
    assert all(creeping)
    assert arm.stand_ms(3 * BEGIN_M) == SETTLED_NS // MS + 20


def test_how_long_an_arm_stood_before_a_stream_moved_does_not_count() -> None:
    arm = Settles()
    arm.stand_ms(2 * BEGIN_M)
    arm.settling.restart()
    assert arm.stand_ms(2 * BEGIN_M) == SETTLED_NS // MS + 20


def test_an_arm_whose_elbow_still_moves_is_not_activated_though_its_tcp_stands() -> None:
    profile = load_profile("fr3")
    kinematics = make_kinematics(profile)
    pose = replace(Ready().pose.record, reference_position_m=None, reference_quat_xyzw=None)
    settling, zero = Settling(kinematics), np.zeros(kinematics.size)
    commanded_rad = np.array(profile.robot.home_rad)
    for step, way_rad in enumerate([0.3, 0.2, 0.1]):
        there_rad = commanded_rad + way_rad
        joint = JointState(kinematics.arm_joints, there_rad, zero, zero)
        settling.measure(pose, joint, START_NS + 200 * step * MS)
        (why,) = settling.unsettled(pose_of(pose), commanded_rad)
        assert f"0.000 rad from its last command, its joints {way_rad:.3f} rad" in why
    assert settling.unsettled(pose_of(pose), there_rad) == []
