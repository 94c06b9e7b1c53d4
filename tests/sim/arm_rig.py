"""The closed loop on a virtual clock, for faults in motion: what is done to it, how it moved.

All figures are of MuJoCo's own TCP, sampled at every command tick.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message, Tamper

from vla_zenoh.codec import message
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.load import override
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import ActionChunk, FloatArray, PoseCommand

RATE_HZ = 10.0
STEP_M = 0.02
SPEED_M_S = RATE_HZ * STEP_M
UP, HOLD = f"0 0 {STEP_M}", "0 0 0"
LIMIT_RTOL = 1e-6
ARM_FACTOR = 1.15
"""The measured arm may be this much faster, or accelerate more, than it is commanded to."""
STILL_M_S = 2e-3
AT_REST = 1e-6
WOBBLE_FACTOR = 2.0
TICK_S = 1 / 250
STARTED_S = 0.7
"""From standing to the speed that is asked for; it is steady later."""
STARVED = 0.30, 0.045
"""Seconds until the arm stands, and metres until then, at most. From the last good chunk: a period,
the watchdog (less the period begun) and the brake."""
BRAKE, OWN, LOST = (0.20, 0.021), (0.15, 0.015), (0.40, 0.060)
FROZEN = 0.50, 0.085
"""The command runs `tracking_m` ahead of a measured pose that stands still, then the brake."""
SILENT = 0.25, 0.035
"""The stream of commands times out, then the robot's own brake."""
READY_S = 0.2
"""Until every node has heard of the others."""


class Asked:
    """A model that is told its step: ``0 0 0.02`` is two centimetres up at every request.

    A fourth number is a delta of the gripper's width.

    Args:
        name: of the worker.
        horizon: steps of a chunk, each of the same size.
    """

    def __init__(self, name: str = "scripted", horizon: int = 1) -> None:
        self.spec = ModelSpec(
            name=name,
            observation=ObservationSpec(
                cameras=(CameraSpec(camera="front"),), state=("pose", "gripper"), prompt=True
            ),
            action=ActionSpec(horizon=horizon, dt_s=0.1, gripper="delta_m"),
        )
        self.horizon = horizon

    def infer(self, observation: Observation) -> ActionSteps:
        step = np.zeros((self.horizon, 7))
        if observation.task.active and re.fullmatch(r"[-+. \d]+", observation.prompt):
            numbers = [float(number) for number in observation.prompt.split()]
            step[:, :3] = numbers[:3]
            step[:, 6] = numbers[3] if len(numbers) > 3 else 0.0
        return ActionSteps(step)


@cache
def shipped() -> Profile:
    # From the first request on at the rate of the tests, so that none waits for a slower one.
    return override(load_profile("panda_sim"), {"task": {"rate_hz": RATE_HZ}})


@cache
def _world() -> World:
    return build_world(shipped())


@cache
def _shadow() -> ReachabilityFilter:
    return ReachabilityFilter(shipped())


def begin(
    prompt: str = HOLD,
    rate_hz: float = RATE_HZ,
    *,
    others: dict[str, Asked] | None = None,
    bounded: bool = False,
    clear: bool = False,
    steps: int = 2,
) -> Lockstep:
    """An active loop at home; the arm begins to move as `prompt` says.

    All loops share one world: a new one ends the one before.

    Args:
        prompt: see `Asked`.
        rate_hz: of the chunks.
        others: more workers.
        bounded: by the arm's kinematics; where only steps and faults matter it just takes time.
        clear: the box is out of reach.
        steps: of the world in a tick: as in the robot node, unless times are of a millisecond.
    """
    world = _world()
    world.reset()
    if clear:
        world.place("box", (0.5, 1.5, 0.0))
    reach = _shadow() if bounded else None
    loop = Lockstep(shipped(), world, Asked(), reach=reach, others=others, steps=steps)
    loop.put("rate", rate_hz)
    loop.put("prompt", prompt)
    loop.run(READY_S)
    activate(loop)
    return loop


def moving(
    seconds: float = 1.0, prompt: str = UP, rate_hz: float = RATE_HZ, *, steps: int = 2
) -> Lockstep:
    """A loop whose arm is in full motion."""
    loop = begin(prompt, rate_hz, steps=steps)
    loop.run(seconds)
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S
    return loop


def after(seconds: float, tamper: Tamper | None = None) -> FloatArray:
    """The measured path up, and of what follows with `tamper` on the wire."""
    loop = moving(STARTED_S)
    loop.tamper = tamper
    loop.run(seconds)
    check_motion(loop)
    return path_m(loop)


@cache
def undisturbed(seconds: float) -> FloatArray:
    """What `after` is compared with."""
    return after(seconds)


def activate(loop: Lockstep) -> None:
    """Activate, and see that it worked."""
    loop.put("active", True)
    loop.run(0.01)
    assert loop.commander.state.value == "active", loop.commander.why


def mark(loop: Lockstep) -> int:
    """Index of now in the trace."""
    return len(loop.trace.time_ns)


# -- what the arm did -----------------------------------------------------------------------------
def path_m(loop: Lockstep) -> FloatArray:
    """(n, 3) measured TCP."""
    return np.array(loop.trace.position_m)


def speed_m_s(loop: Lockstep) -> FloatArray:
    """(n - 1,) of the measured TCP."""
    return np.linalg.norm(np.diff(path_m(loop), axis=0), axis=1) / TICK_S


def stop_time_s(loop: Lockstep, since: int) -> float:
    """When the measured TCP moved for the last time, after `since`."""
    fast = np.flatnonzero(speed_m_s(loop)[since:] > STILL_M_S)
    return 0.0 if not len(fast) else float((fast[-1] + 1) * TICK_S)


def way_m(loop: Lockstep, since: int) -> float:
    """How far the measured TCP got from where it was at `since`, at most."""
    path = path_m(loop)
    return float(np.linalg.norm(path[since:] - path[since - 1], axis=1).max())


def check_stop(loop: Lockstep, since: int, within: tuple[float, float]) -> None:
    """It stood within so many seconds and metres of `since`."""
    stop_s, stop_m = within
    assert stop_time_s(loop, since) < stop_s
    assert way_m(loop, since) < stop_m


def goes_on(loop: Lockstep) -> None:
    """Activated again it moves from where it is, without a jump."""
    activate(loop)
    loop.run(0.4)
    assert speed_m_s(loop)[-1] > 0.5 * SPEED_M_S


def check_motion(
    loop: Lockstep, *, own_brake: bool = False, contact: bool = False, singular: bool = False
) -> None:
    """Every command and the measured arm kept the profile's limits from beginning to end.

    Args:
        own_brake: the robot braked by itself, which may be harder.
        contact: it touched something, which accelerates it as it likes.
        singular: it was stretched out, where it follows less exactly.
    """
    _check_commands(loop)
    limits, margin = loop.profile.limits.translation, BRAKE_MARGIN if own_brake else 1.0
    margin *= WOBBLE_FACTOR if singular else 1.0
    path = path_m(loop)
    assert np.isfinite(path).all()
    velocity = np.diff(path, axis=0) / TICK_S
    assert np.abs(velocity).max() <= limits.velocity_m_s * ARM_FACTOR
    if not contact:
        acceleration = np.diff(velocity, axis=0) / TICK_S
        assert np.abs(acceleration).max() <= limits.acceleration_m_s2 * ARM_FACTOR * margin


def _check_commands(loop: Lockstep) -> None:
    limits = loop.profile.limits
    bounds = [
        (low, high)
        for low, high in zip(
            limits.translation.model_dump().values(),
            limits.rotation.model_dump().values(),
            strict=True,
        )
    ]
    for run in _streams(loop.trace.commands):
        twist = np.array([command.twist for command in run])
        acceleration = np.array([command.acceleration for command in run])
        position_m = np.array([command.position_m for command in run])
        jerk = np.diff(acceleration, axis=0) / TICK_S
        for values, (translation, rotation) in zip(
            (twist, acceleration, jerk), bounds, strict=True
        ):
            assert np.abs(values[:, :3]).max(initial=0.0) <= translation * (1 + LIMIT_RTOL)
            turning = np.linalg.norm(values[:, 3:], axis=1)
            assert turning.max(initial=0.0) <= rotation * (1 + LIMIT_RTOL)
        # Nothing jumps: position is what the velocity made of it.
        explained = (twist[:-1, :3] + twist[1:, :3]) * (TICK_S / 2)
        apart = np.abs(np.diff(position_m, axis=0) - explained)
        assert apart.max(initial=0.0) <= bounds[2][0] * TICK_S**3
        # A stream begins and ends with an arm that stands.
        assert np.abs(twist[0]).max() <= bounds[2][1] * TICK_S**2


def _streams(commands: list[PoseCommand | None]) -> Iterable[list[PoseCommand]]:
    run: list[PoseCommand] = []
    for command in [*commands, None]:
        if command is not None:
            if run and _anchored_anew(run[-1], command):
                yield run
                run = []
            run.append(command)
        elif run:
            yield run
            run = []


def _anchored_anew(before: PoseCommand, now: PoseCommand) -> bool:
    """Standing, and from another place: where the robot's own brake has put the arm."""
    return (
        float(np.abs(before.twist).max()) < AT_REST
        and before.state != "active"
        and now.state == "active"
        and float(np.abs(now.position_m - before.position_m).max()) > 1e-5
    )


# -- what is done to messages ---------------------------------------------------------------------
def delayed(by_s: float, *kinds: type) -> Tamper:
    """Messages of these kinds arrive later."""

    return lambda sent: [later(sent, by_s) if sent.kind in kinds else sent]


def dropped(*kinds: type) -> Tamper:
    """Messages of these kinds are lost."""
    return lambda sent: [] if sent.kind in kinds else [sent]


def with_fields(sent: Message, **fields: Any) -> Message:
    """The same message with other fields in its payload."""
    data = message.unpack(sent.payload)
    return replace(sent, payload=message.pack({**data, **fields}))


def changed(kind: type, **fields: Any) -> Tamper:
    """Messages of this kind have other fields in their payload."""
    return lambda sent: [with_fields(sent, **fields) if sent.kind is kind else sent]


def early(sent: Message) -> Iterable[Message]:
    """A chunk that is stamped 0.2 s from now."""
    if sent.kind is not ActionChunk:
        return [sent]
    data, ahead_ns = message.unpack(sent.payload), 200_000_000
    stamps = {name: data[name] + ahead_ns for name in ("observation_stamp_ns", "valid_until_ns")}
    header = replace(sent.header, stamp_wall_ns=sent.header.stamp_wall_ns + ahead_ns)
    return [with_fields(replace(sent, header=header), **stamps)]


def spoilt(kind: type, name: str) -> Tamper:
    """One number of this field is not one."""

    def tamper(sent: Message) -> Iterable[Message]:
        if sent.kind is not kind:
            return [sent]
        value = np.array(message.unpack(sent.payload)[name])
        value.reshape(-1)[-1] = [np.nan, np.inf, -np.inf][sent.header.seq % 3]
        return [with_fields(sent, **{name: value})]

    return tamper


def frozen(*kinds: type, payload_only: bool) -> Tamper:
    """The first message of each kind is sent again and again; `payload_only`: as a new one."""
    kept: dict[type, Message] = {}

    def tamper(sent: Message) -> Iterable[Message]:
        if sent.kind not in kinds:
            return [sent]
        first = kept.setdefault(sent.kind, sent)
        if payload_only:
            return [replace(sent, payload=first.payload)]
        return [replace(first, arrival_ns=sent.arrival_ns)]

    return tamper


def chunks_only(change: Callable[[Message], Iterable[Message]]) -> Tamper:
    """Only chunks are tampered with."""
    return lambda sent: change(sent) if sent.kind is ActionChunk else [sent]


def later(sent: Message, by_s: float) -> Message:
    """The same message arrives later."""
    return replace(sent, arrival_ns=sent.arrival_ns + round(by_s * 1e9))
