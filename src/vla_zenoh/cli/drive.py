"""vla-zenoh prompt, activate, deactivate, use, rate, speed, stop, reset: one setting each."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from vla_zenoh.cli.options import AnswerOption, options
from vla_zenoh.cli.plain import BOLD_RED, complain, fail, json_answer, say, say_marked, warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import CodecError, SecurityError, nearest
from vla_zenoh.keys import CRASHED, Keys, worker_node

if TYPE_CHECKING:
    from vla_zenoh.bus.client import Client
    from vla_zenoh.types import Task

PATIENCE_S = 3.0
DISCOVERY_S, POLL_S = 1.0, 0.05
"""A router's first answers may lack robots that are alive: `stop --all` asks for this long."""
MODE_PATIENCE_S = 1.0
ABSENT_PATIENCE_S = 1.5
"""A command node that is alive may take this long to appear."""
SILENT_S = 2.0
"""The command node publishes its status twice a second."""
LEAVING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


def _answered(command: Callable[..., None]) -> Callable[..., None]:
    """A command that prints its answer as JSON if its `as_json` is true."""

    @wraps(command)
    def run(*positional: Any, as_json: bool = False, **named: Any) -> None:
        with json_answer() if as_json else nullcontext():
            command(*positional, **named)

    return run


@options
@_answered
def prompt(
    text: Annotated[str, typer.Argument(help="Instruction for the model, in words.")],
    target: RobotTarget,
    as_json: AnswerOption = False,
) -> None:
    """Set the prompt. Any Zenoh client can: put the text on <root>/<robot>/prompt."""
    from vla_zenoh.codec.settings import decode_text

    if not decode_text(text.encode()):  # rejects it before a router is asked
        raise CodecError(
            "invalid",
            "the prompt is empty: give the task in words, as in "
            f"`{target.typed('prompt', 'HARD: go up')}`; `{target.typed('deactivate')}` brakes "
            "the arm",
        )
    with target.operator("prompt", text) as client:
        task = client.set_prompt(text)
        said = f"prompt: {task.prompt!r} (worker {task.worker}, {task.rate_hz:g} Hz)"
        _show(target, client, said)


@options
@_answered
def activate(
    target: RobotTarget,
    held: Annotated[
        bool, typer.Option("--hold", help="Stay: the arm is active only while this runs (deadman).")
    ] = False,
    as_json: AnswerOption = False,
) -> None:
    """Let the worker move the arm. Rejected with every reason while something is not ready."""
    from vla_zenoh.runtime.process import stop_on_signals

    with target.operator("activate") as client:
        stop = stop_on_signals() if held else None
        task = client.activate() if stop is None else client.activate_with_deadman("person")
        what = f"worker {task.worker}, prompt {task.prompt!r}, {task.rate_hz:g} Hz"
        _show(target, client, f"{_mode(client)} | active: {what}")
        if stop is not None:
            _hold(target, client, task, stop)


def _mode(client: Client) -> str:
    """SIM, DRY RUN or LIVE: prefix of messages about the arm's motion."""
    from vla_zenoh.cli.node_rows import MODE_WORDS, mode_of

    client.wait_for(lambda: client.status("command"), MODE_PATIENCE_S)
    return MODE_WORDS[mode_of(client.snapshot())][0]


def _hold(target: RobotTarget, client: Client, activated: Task, stop: threading.Event) -> None:
    """Wait until the arm is inactive; Ctrl-C brakes it."""
    say("The arm stays active while this command runs; Ctrl-C, or losing this process, brakes it.")
    while not stop.wait(POLL_S):
        if why := _inactive(client, activated):
            fail(f"the arm is no longer active: {why}; {target.named(client)}")
    _deactivate(target, client)
    raise SystemExit(130)


def _inactive(client: Client, activated: Task) -> str:
    """Why the arm is no longer active since `activated`; empty while it is."""
    if "command" not in client.alive:
        return "its command node is not alive"
    status = client.status("command")
    if status is None or status.state in ("active", "holding"):
        return ""
    if not status.detail.get("at_rest"):  # it brakes or retreats, which ends with the deadman
        return ""
    episode = status.detail.get("episode")
    if not isinstance(episode, int) or episode < activated.episode:  # from before the activation
        return ""
    return str(status.detail.get("why", "")) or status.state


@options
@_answered
def deactivate(target: RobotTarget, as_json: AnswerOption = False) -> None:
    """Brake the arm; then no worker moves it."""
    with target.client(stop=True) as client:
        _deactivate(target, client)


def _deactivate(target: RobotTarget, client: Client) -> None:
    if not client.deactivate(PATIENCE_S):
        _fail(target, client, "deactivate", "confirm that the arm stands")
    _show(target, client, "inactive, the arm stands", ": ")


@options
@_answered
def use(
    worker: Annotated[str, typer.Argument(help="Worker whose chunks move the arm.")],
    target: RobotTarget,
    as_json: AnswerOption = False,
) -> None:
    """Select the worker that moves the arm; the others keep running."""
    from vla_zenoh.codec.settings import decode_name

    decode_name(worker.encode())
    with target.operator("use", worker) as client:
        _require_worker(client, worker)
        _show(target, client, f"worker: {client.set_worker(worker).worker}")


def _require_worker(client: Client, worker: str) -> None:
    """Exit with the list of live workers if `worker` is not among them: it may be mistyped."""
    found = client.wait_for(lambda: worker_node(worker) in client.alive, ABSENT_PATIENCE_S)
    if not found and "command" in client.alive:  # otherwise that is reported
        named = worker_node("")
        alive = sorted(name[len(named) :] for name in client.alive if name.startswith(named))
        said = client.status(worker_node(worker))
        why = nearest(worker, alive)
        if said is not None and said.state == CRASHED:
            why = f": {said.detail.get('complaint', '')}."
        fail(f"worker {worker!r} is not alive{why} Alive are: {', '.join(alive) or 'none'}")


@options
@_answered
def rate(
    rate_hz: Annotated[float, typer.Argument(help="Chunks per second.")],
    target: RobotTarget,
    as_json: AnswerOption = False,
) -> None:
    """Set how often the workers infer."""
    from vla_zenoh.codec.settings import decode_rate

    decode_rate(f"{rate_hz:g}".encode())
    with target.operator("rate", f"{rate_hz:g}") as client:
        _show(target, client, f"rate: {client.set_rate(rate_hz).rate_hz:g} Hz")


@options
@_answered
def speed(
    target: RobotTarget,
    percent: Annotated[
        str | None,
        typer.Argument(help="0 to 100; at 0 the arm stands, still active. Default: show it."),
    ] = None,
    as_json: AnswerOption = False,
) -> None:
    """Slow the arm down on the same path. Lowering needs only the right to stop."""
    from vla_zenoh.codec.settings import decode_percent

    wanted = None if percent is None else decode_percent(percent.encode())
    with target.client(stop=wanted is not None) as client:
        task = client.wait_for(lambda: client.task, PATIENCE_S)
        if task is None:
            _fail(target, client, "speed", "publish its speed")
        lower = wanted is not None and wanted <= task.speed_percent
        if lower and (why := target.not_operator(client.profile, "speed", f"{wanted:g}")):
            raise SecurityError(why)
        if wanted is None or lower:
            task = task if wanted is None else client.slow_down(wanted)
            _show(target, client, f"speed: {task.speed_percent:g} % of the planned speed")
            return
    with target.operator("speed", f"{wanted:g}") as client:
        task = client.set_speed(wanted)
        _show(target, client, f"speed: {task.speed_percent:g} % of the planned speed")


@options
@_answered
def stop(
    target: RobotTarget,
    every: Annotated[
        bool, typer.Option("--all", help="Every robot that is visible on this router.")
    ] = False,
    wait_key: Annotated[
        bool,
        typer.Option(
            "--wait-key", help="Stay: every key stops the robot, and so does leaving (Ctrl-C)."
        ),
    ] = False,
    as_json: AnswerOption = False,
) -> None:
    """Emergency stop: brake now and stay stopped until `vla-zenoh reset`."""
    if wait_key:
        _stop_by_key(target, every=every)
        return
    with target.client(stop_now=True) as client:
        _confirm_stop(target, client, every=every)


def _confirm_stop(target: RobotTarget, client: Client, *, every: bool) -> None:
    """Stop the others too if wanted, and wait for the confirmation."""
    if every:
        _stop_all(target, client)
        return
    if not _reaches(client, client.stopped):
        _fail(target, client, "stop", "confirm that it stopped")
    _show_stopped(target, client, client.profile.robot.name)
    if others := target.others(client):
        warn(f"not stopped: {', '.join(others)}; `{target.typed('stop', '--all')}` stops all")


@options
@_answered
def reset(target: RobotTarget, as_json: AnswerOption = False) -> None:
    """Clear an emergency stop or a fault. The arm stays inactive."""
    with target.operator("reset") as client:
        client.reset()
        if not _reaches(client, client.cleared):
            status = client.status("command")
            if status is None or not client.latch_reason() or "command" not in client.alive:
                _fail(target, client, "reset", "answer")
            fail(f"not cleared: {status.detail.get('why', '')}: {target.named(client)}")
        _show(target, client, "reset; inactive", ": ")


def _reaches(client: Client, done: Callable[[], bool]) -> bool:
    """Wait until `done`; gives up sooner if there is no command node."""
    absent_s = time.monotonic() + ABSENT_PATIENCE_S

    def settled() -> bool:
        return done() or ("command" not in client.alive and time.monotonic() > absent_s)

    client.wait_for(settled, PATIENCE_S)
    return done()


def _fail(target: RobotTarget, client: Client, command: str, what: str) -> NoReturn:
    """Exit with the reason why the command node did not do `what`."""
    if why := target.not_operator(client.profile, command):
        fail(f"{target.named(client)} does not {what}: {why}")
    if "command" not in client.alive:
        fail(target.no_node(client, command, kind="command node"))
    see = target.typed("status")
    fail(f"the command node of {target.named(client)} does not {what}; see `{see}`")


def _stop_all(target: RobotTarget, own: Client) -> None:
    from vla_zenoh.bus.client import Client
    from vla_zenoh.bus.session import alive_robots

    robots: list[str] = []
    give_up = time.monotonic() + DISCOVERY_S
    while time.monotonic() < give_up:
        for robot in alive_robots(own.session, own.keys):
            if robot not in robots:
                own.publish(Keys(robot, own.keys.root).stop, "stop")
                robots.append(robot)
        time.sleep(POLL_S)
    if not robots:
        why = target.not_operator(own.profile, "stop")
        fail(f"no robot is visible on this router. {why}".rstrip(". "))
    clients: list[Client] = []
    for robot in robots:
        named = own.profile.robot.model_copy(update={"name": robot})
        other = own.profile.model_copy(update={"robot": named})
        clients.append(Client(other, own.session).subscribe())
    done = [_reaches(client, client.stopped) for client in clients]
    for client, stopped in zip(clients, done, strict=True):
        if stopped:
            _show_stopped(target, client, own.keys.robot)
        else:
            complain(f"{target.named(client)} does not confirm that it stopped")
    if not all(done):
        fail(target.not_operator(own.profile, "stop", "--all") or "not every robot has stopped")


def _show_stopped(target: RobotTarget, client: Client, own: str) -> None:
    robot = client.keys.robot
    how = target.typed("reset", robot=None if robot == own else robot)
    say_marked("stopped", BOLD_RED, f": {target.named(client)}; `{how}` clears it")


def _show(target: RobotTarget, client: Client, text: str, separator: str = ", ") -> None:
    say(f"{text}{separator}{target.named(client)}")


# -- stop --wait-key: a standby emergency stop for a person beside the arm ------------------------
def _stop_by_key(target: RobotTarget, *, every: bool) -> None:
    """Stop the robot at every key, and when the person leaves; the session stays open meanwhile."""
    with target.client(stop=True) as client, _keys() as pressed:
        connected = True
        try:
            name = target.named(client)
            client.wait_for(lambda: _connected(client), ABSENT_PATIENCE_S)
            say(f"Every key stops {name}; so does leaving: Ctrl-C, or closing this terminal.")
            while (key := pressed()) is not False:
                if key:
                    client.stop()
                    with suppress(SystemExit):  # reported already; stay on standby
                        _confirm_stop(target, client, every=every)
                if connected != (connected := _connected(client)):
                    if connected:
                        say(f"Connected: every key stops {name}.")
                    else:
                        silent = f": its command node is silent, no key stops {name}"
                        say_marked("NOT CONNECTED", BOLD_RED, silent)
        finally:
            client.stop()
            with suppress(OSError):  # the terminal may be gone
                _confirm_stop(target, client, every=every)


def _connected(client: Client) -> bool:
    found = client.snapshot().get("command")
    return found is not None and found[2] and found[1] < SILENT_S


@contextmanager
def _keys() -> Iterator[Callable[[], bool | None]]:
    """A function that waits briefly for a key: True; None: there was none; False: input ended.

    Signals that end or suspend a program raise `KeyboardInterrupt`, the first one alone.
    """
    number = sys.stdin.fileno()

    def pressed() -> bool | None:
        if not select.select([number], [], [], POLL_S)[0]:
            return None
        return bool(os.read(number, 4096))

    def leave(*_: object) -> None:
        for each in LEAVING:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {each: signal.signal(each, leave) for each in LEAVING}
    restore = _single_keys(number)
    try:
        yield pressed
    finally:
        restore()
        for each, handler in before.items():
            signal.signal(each, handler)


def _single_keys(number: int) -> Callable[[], None]:
    """Let a terminal deliver every key at once, without echo; returns what undoes that."""
    if not os.isatty(number):
        return lambda: None
    import termios
    import tty

    before = termios.tcgetattr(number)
    tty.setcbreak(number)

    def restore() -> None:
        with suppress(termios.error, OSError):  # the terminal may be gone
            termios.tcsetattr(number, termios.TCSADRAIN, before)

    return restore
