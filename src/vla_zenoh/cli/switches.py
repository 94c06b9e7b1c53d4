"""vla-zenoh activate, deactivate, use, rate, speed, stop, reset: one put each."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, NoReturn

import typer

from vla_zenoh.bus.client import Client
from vla_zenoh.bus.liveliness import alive_robots
from vla_zenoh.cli.deadman import hold
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    ProfileOption,
    RobotOption,
)
from vla_zenoh.cli.output import complain, console, errors, fail, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.codec.settings import decode_percent
from vla_zenoh.errors import SecurityError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import as_robot
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh.types import Task

STOP_PATIENCE_S = 3.0
LOOK_S, POLL_S = 1.0, 0.05
"""A router's first answers may lack robots that are alive: so long it is asked for more."""
ABSENT_PATIENCE_S = 1.5
"""So long a command node that lives may take to be seen."""


def activate(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
    while_here: Annotated[
        bool,
        typer.Option("--hold", help="Stay: the arm obeys only while this runs and is connected."),
    ] = False,
) -> None:
    """Give the arm to the worker. Refused with every reason while something is not right."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.driver("activate") as client:
        stop = stop_on_signals() if while_here else None
        task = client.activate() if stop is None else client.activate_with_deadman("person")
        console().print(
            f"active: worker {task.worker}, prompt {task.prompt!r}, {task.rate_hz:g} Hz, "
            f"{aim.named(client)}",
            soft_wrap=True,
        )
        if stop is not None:
            hold(aim, client, task, stop)


def deactivate(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Brake, and obey nobody."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.client(stop=True) as client:
        if not client.deactivate(STOP_PATIENCE_S):
            _complain(aim, client, "deactivate", "say that the arm stands")
        console().print(f"inactive, the arm stands: {aim.named(client)}", soft_wrap=True)


def use(
    worker: Annotated[str, typer.Argument(help="Worker whose chunks are to be obeyed.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Choose the worker that is obeyed; the others go on beside it."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.driver("use", worker) as client:
        task = client.set_worker(worker)
        console().print(f"worker: {task.worker}, {aim.named(client)}", soft_wrap=True)


def rate(
    rate_hz: Annotated[float, typer.Argument(help="Chunks per second.")],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Choose how often the workers infer."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.driver("rate", f"{rate_hz:g}") as client:
        task = client.set_rate(rate_hz)
        console().print(f"rate: {task.rate_hz:g} Hz, {aim.named(client)}", soft_wrap=True)


def speed(
    percent: Annotated[
        str | None,
        typer.Argument(help="0 to 100; 0: it stands, still active. Without it: what it is now."),
    ] = None,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Drive slower than planned, on the same path. Who may stop the arm may lower it."""
    aim = RobotTarget(profile, connect, host, robot)
    wanted = None if percent is None else decode_percent(percent.encode())
    # To lower it is like a stop: as whoever may, of those whose certificates lie here.
    with aim.client(stop=wanted is not None) as client:
        task = client.wait_for(lambda: client.task, STOP_PATIENCE_S)
        if task is None:
            _complain(aim, client, "speed", "say how fast it is driven")
        lower = wanted is not None and wanted <= task.speed_percent
        if lower and (why := aim.powerless(client.profile, "speed", f"{wanted:g}")):
            raise SecurityError(why)
        if wanted is None or lower:
            _tell_speed(aim, client, task if wanted is None else client.slow_down(wanted))
            return
    with aim.driver("speed", f"{wanted:g}") as client:
        _tell_speed(aim, client, client.set_speed(wanted))


def _tell_speed(aim: RobotTarget, client: Client, task: Task) -> None:
    console().print(
        f"speed: {task.speed_percent:g} % of what is planned, {aim.named(client)}", soft_wrap=True
    )


def stop(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
    every: Annotated[
        bool, typer.Option("--all", help="Every robot on this router that one may know of.")
    ] = False,
) -> None:
    """Emergency stop: brake now, and stay stopped until `vla-zenoh reset`."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.client(stop=True) as client:
        client.publish(client.keys.stop, "stop")
        if every:
            _stop_all(aim, client)
            return
        if not _stops(client):
            _complain(aim, client, "stop", "say that it stopped")
        _tell_stopped(aim, client, client.profile.robot.name)
        if others := aim.others(client):
            more = f"not stopped: {', '.join(others)}; `{aim.typed('stop', '--all')}` stops all"
            errors().print(styled(more, "yellow"), soft_wrap=True)


def reset(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    host: HostOption = None,
    robot: RobotOption = None,
) -> None:
    """Clear an emergency stop or a fault. The arm stays inactive."""
    aim = RobotTarget(profile, connect, host, robot)
    with aim.driver("reset") as client:
        client.publish(client.keys.reset, "reset")
        if not _heeded(client, lambda: _state(client) not in ("", "stopped", "fault")):
            status = client.status("command")
            if status is None or "command" not in client.alive:
                _complain(aim, client, "reset", "answer")
            fail(f"not cleared: {status.detail.get('why', '')}: {aim.named(client)}")
        console().print(f"reset; inactive: {aim.named(client)}", soft_wrap=True)


def _state(client: Client) -> str:
    status = client.status("command")
    return status.state if status is not None else ""


def _stops(client: Client) -> bool:
    return _heeded(client, lambda: _state(client) == "stopped")


def _heeded(client: Client, done: Callable[[], bool]) -> bool:
    """Whether the command node did it; gives up sooner where there is none."""
    absent_s = time.monotonic() + ABSENT_PATIENCE_S

    def settled() -> bool:
        return done() or ("command" not in client.alive and time.monotonic() > absent_s)

    client.wait_for(settled, STOP_PATIENCE_S)
    return done()


def _complain(aim: RobotTarget, client: Client, command: str, what: str) -> NoReturn:
    """Ends the command: the command node did not do `what`."""
    if why := aim.powerless(client.profile, command):
        fail(f"{aim.named(client)} does not {what}: {why}")
    if "command" not in client.alive:
        fail(aim.absent(client, command))
    fail(
        f"the command node of {aim.named(client)} does not {what}; look at `{aim.typed('status')}`"
    )


def _stop_all(aim: RobotTarget, own: Client) -> None:
    robots: list[str] = []
    give_up = time.monotonic() + LOOK_S
    while time.monotonic() < give_up:
        for robot in alive_robots(own.session, own.keys):
            if robot not in robots:
                own.publish(Keys(robot, own.keys.root).stop, "stop")
                robots.append(robot)
        time.sleep(POLL_S)
    if not robots:
        why = aim.powerless(own.profile, "stop")
        fail(f"no robot on this router is alive, as far as one may know here. {why}".rstrip(". "))
    clients = [Client(as_robot(own.profile, robot), own.session).subscribe() for robot in robots]
    done = [_stops(client) for client in clients]
    for client, stopped in zip(clients, done, strict=True):
        if stopped:
            _tell_stopped(aim, client, own.keys.robot)
        else:
            complain(f"{aim.named(client)} does not say that it stopped")
    if not all(done):
        fail(aim.powerless(own.profile, "stop", "--all") or "not every robot has stopped")


def _tell_stopped(aim: RobotTarget, client: Client, meant: str) -> None:
    robot = client.keys.robot
    how = aim.typed("reset", robot=None if robot == meant else robot)
    console().print(
        styled("stopped", "bold red"),
        f": {aim.named(client)}; `{how}` clears it",
        sep="",
        soft_wrap=True,
    )
