"""vla-zenoh prompt, activate, deactivate, use, rate, speed, stop, reset: one setting each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from vla_zenoh.cli.options import AnswerOption, options
from vla_zenoh.cli.plain import fail, json_answer, say
from vla_zenoh.cli.target import OWN_STOP, RobotTarget
from vla_zenoh.client.client import ABSENT_PATIENCE_S, Client
from vla_zenoh.errors import CodecError, SecurityError, nearest
from vla_zenoh.keys import CRASHED, worker_node

if TYPE_CHECKING:
    from vla_zenoh.types import Task

PATIENCE_S = 3.0
POLL_S = 0.05
MODE_PATIENCE_S = 1.0
ANSWER_S = 1.0
FAILED = ("contract: ", "inference_failed: ")
"""A complaint of a worker begins with it where its model did not answer."""


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
    """Set the prompt. Any Zenoh client can: put the text on <root>/<robot>/prompt.

    Exit status 1 where the worker says within 1 s that its model cannot answer it; it is set all
    the same.

    A moving arm carries on with its plan until the worker has answered the new prompt; without an
    answer it stands timing.max_open_loop_s and watchdog_s after the last chunk, 2.8 s by default.
    `vla-zenoh speed 0` or `deactivate` stop it before that.
    """
    from vla_zenoh.codec.settings import decode_text, encode_text

    if not decode_text(encode_text(text)):  # rejects it before a router is asked
        raise CodecError(
            "invalid",
            "the prompt is empty: give the task in words, as in "
            f"`{target.typed('prompt', 'HARD: go up')}`; `{target.typed('deactivate')}` brakes "
            "the arm",
        )
    with target.operator("prompt", text) as client:
        task = client.set_prompt(text)
        said = f"prompt: {task.prompt!r} (worker {task.worker}, {task.rate_hz:g} Hz)"
        if why := _unanswered(client, task):
            fail(f"{said}, and the worker cannot answer it: {why}")
        _show(target, client, said)


def _unanswered(client: Client, task: Task) -> str:
    """What the worker says against its prompt within `ANSWER_S`; empty: nothing."""

    def complaint() -> str:
        status = client.status(worker_node(task.worker))
        detail = {} if status is None else status.detail
        why = str(detail.get("complaint", ""))
        return why if detail.get("prompt") == task.prompt and why.startswith(FAILED) else ""

    return client.wait_for(complaint, ANSWER_S) or ""


@options
@_answered
def activate(
    target: RobotTarget,
    held: Annotated[
        bool, typer.Option("--hold", help="Stay: the arm is active only while this runs (deadman).")
    ] = False,
    as_json: AnswerOption = False,
) -> None:
    """Let the worker move the arm. Rejected with every reason while something is not ready.

    While the only reasons are that router, nodes, cameras or the model are starting, it waits up to
    20 s, as do the other commands that need the command node.
    """
    from vla_zenoh.runtime.process import stop_on_signals

    with target.operator("activate") as client:
        stop = stop_on_signals() if held else None
        before = client.wait_for(lambda: client.task, MODE_PATIENCE_S)
        task = client.activate() if stop is None else client.activate_with_deadman("person")
        # Every activation begins an episode: in the same one it was not this command's.
        ours = before is None or not before.active or before.episode != task.episode
        active = "active" if ours else "was active already"
        what = f"worker {task.worker}, prompt {task.prompt!r}, {task.rate_hz:g} Hz"
        _show(target, client, f"{_mode(client)} | {active}: {what}")
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
    from vla_zenoh.codec.settings import decode_name, encode_text

    decode_name(encode_text(worker))
    with target.operator("use", worker) as client:
        _require_worker(client, worker)
        _show(target, client, f"worker: {client.set_worker(worker).worker}")


def _require_worker(client: Client, worker: str) -> None:
    """Exit with the list of live workers if `worker` is not among them: it may be mistyped."""
    if (
        not client.await_start(worker_node(worker)) and "command" in client.alive
    ):  # otherwise that is reported
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
    from vla_zenoh.codec.settings import decode_percent, encode_text

    wanted = None if percent is None else decode_percent(encode_text(percent))
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
    """Emergency stop: brake now and stay stopped until `vla-zenoh reset`.

    Exit status 0, CONFIRMED: the robot's own states show that it stands. 3, HEARD: a node has
    latched the stop, but the arm does not stand yet. 4, NOT CONFIRMED: no answer; the stop may have
    arrived all the same: use the robot's own emergency stop. --json prints one line for each.
    """
    from vla_zenoh.cli.stop import stop_and_watch, stop_by_key

    if wait_key:
        stop_by_key(target, every=every)
    else:
        stop_and_watch(target, every=every, as_json=as_json)


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
    then = f". {OWN_STOP}" if command == "deactivate" else ""
    if "command" not in client.alive:
        fail(f"{target.no_node(client, command, kind='command node')}{then}")
    see = target.typed("status")
    fail(f"the command node of {target.named(client)} does not {what}; see `{see}`{then}")


def _show(target: RobotTarget, client: Client, text: str, separator: str = ", ") -> None:
    say(f"{text}{separator}{target.named(client)}")
