"""``vla-zenoh stop``: an emergency stop, and what became of it.

Whatever may hang as the router does, opening a session or a put, is done by a thread of its own:
the person reads within a second whether somebody heard the stop.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import zenoh

from vla_zenoh.bus.session import alive_robots, put_text
from vla_zenoh.cli.plain import BOLD_RED, say, say_marked, warn
from vla_zenoh.cli.silence import BEGAN_S, silence
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.client import Client, StopClient, StopOutcome, StopProgress
from vla_zenoh.errors import SecurityError, SessionError
from vla_zenoh.keys import Keys
from vla_zenoh.profile import Profile
from vla_zenoh.profile.stop_profile import StopProfile

EXIT_STATUS = {StopOutcome.CONFIRMED: 0, StopOutcome.HEARD: 3, StopOutcome.NOT_CONFIRMED: 4}
FIRST_WORD_S, LEAST_WAIT_S = 0.8, 0.3
"""Without an answer that is said so long after the program began, and after it asked. Where the
imports alone take longer, `cli.silence` has said it."""
GIVE_UP_S = 10.0
"""It tries, and watches the arm, for so long."""
AGAIN_S, RETRY_S, POLL_S, ENDS_S = 0.5, 0.2, 0.05, 0.5
INTERRUPTED = 130
SILENT_S, APPEAR_S = 2.0, 1.5
LEAVING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


class StopAttempt:
    """A stop on its way: a thread puts it, again and again until each robot's nodes have heard it.

    `clients` has a client of every robot that is to stop; `why` is why there is none yet.
    """

    def __init__(self, target: RobotTarget, profile: Profile | StopProfile, *, every: bool) -> None:
        self.target, self.profile, self._every = target, profile, every
        self.clients: list[StopClient] = []
        self.why = f"the router at {', '.join(profile.session.connect)} does not answer"
        self.over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stop", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self.over.is_set():
            try:
                profile, session = self.target.stop_session(self.profile)
            except (SecurityError, SessionError) as error:
                self.why = str(error).partition(". ")[0]
                self.over.wait(RETRY_S)
                continue
            self.profile = profile  # with the host of the certificate that is used
            try:
                self._stop(profile, session)
            except (SessionError, zenoh.ZError) as error:
                self.why = str(error)
            return

    def _stop(self, profile: Profile | StopProfile, session: zenoh.Session) -> None:
        put_text(session, profile.keys.stop, "stop")
        self.why = "no node of it answers"
        known = [profile.robot.name]
        self._add(session, profile.keys)
        client = self.clients[0]
        there = "" if self._every else self.target.alive(client, "stop")
        if there and not client.alive:
            every = self.target.typed("stop", "--all")
            self.why = f"no node of it answers. {there}; `{every}` stops all"
        while not self.over.is_set():
            for robot in alive_robots(session, profile.keys) if self._every else ():
                if robot not in known:
                    keys = Keys(robot, profile.keys.root)
                    put_text(session, keys.stop, "stop")
                    known.append(robot)
                    self._add(session, keys)
            self.over.wait(AGAIN_S)
            for client in self.clients:
                if client.stop_progress().outcome is StopOutcome.NOT_CONFIRMED:
                    client.publish(client.keys.stop, "stop")

    def _add(self, session: zenoh.Session, keys: Keys) -> None:
        client = StopClient(session, keys, self.profile.part_names).subscribe()
        client.stop()
        self.clients.append(client)

    def end(self, status: int) -> None:
        """End the thread, or the program with `status` where a router that hangs keeps it.

        Python would end such a thread within Zenoh, which aborts the program.
        """
        self.over.set()
        self._thread.join(ENDS_S)
        if self._thread.is_alive():
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    def progress(self) -> dict[str, StopProgress]:
        """Progress of each robot; with ``--all`` the profile's own only if it is there."""
        found = {client.keys.robot: client.stop_progress() for client in self.clients}
        own = self.profile.robot.name
        absent = own in found and not any(
            client.alive for client in self.clients if client.keys.robot == own
        )
        if self._every and len(found) > 1 and absent:
            del found[own]
        return found or {own: StopProgress(StopOutcome.NOT_CONFIRMED, (), None)}


def stop_and_watch(target: RobotTarget, *, every: bool, as_json: bool) -> None:
    """Stop, say what became of it, and exit with the status of the worst outcome."""
    attempt, status = StopAttempt(target, target.load_for_stop(), every=every), INTERRUPTED
    try:
        status = EXIT_STATUS[_watch(attempt, every=every, as_json=as_json)]
    finally:
        attempt.end(status)
    if status:
        raise SystemExit(status)


def _watch(attempt: StopAttempt, *, every: bool, as_json: bool) -> StopOutcome:
    """Say every change of the outcome, until all robots stand or it gives up."""
    began_s, said = time.monotonic(), dict[str, StopOutcome]()
    first_word_s = max(BEGAN_S + FIRST_WORD_S, began_s + LEAST_WAIT_S)
    discovering_s = began_s + FIRST_WORD_S if every else began_s
    while True:
        now_s, progress = time.monotonic(), attempt.progress()
        for robot, found in progress.items():
            waits = found.outcome is StopOutcome.NOT_CONFIRMED and now_s < first_word_s
            braking = found.outcome is StopOutcome.HEARD and now_s < first_word_s
            if not waits and not braking and said.get(robot) is not found.outcome:
                said[robot] = found.outcome
                _say(attempt, robot, found, as_json=as_json)
        order = list(EXIT_STATUS)
        worst = max((each.outcome for each in progress.values()), key=order.index)
        done = worst is StopOutcome.CONFIRMED and now_s > discovering_s
        if done or now_s > began_s + GIVE_UP_S:
            if not every and worst is not StopOutcome.NOT_CONFIRMED and not as_json:
                _warn_of_others(attempt)
            return worst
        time.sleep(POLL_S)


def _say(attempt: StopAttempt, robot: str, found: StopProgress, *, as_json: bool) -> None:
    silence.cancel()
    target, own = attempt.target, attempt.profile.robot.name
    named = f"robot {robot} (profile {target.profile})"
    why = target.not_operator(attempt.profile, "stop") or attempt.why
    sentence = found.sentence(named, f"{why}; trying again for {GIVE_UP_S:g} s")
    if found.outcome is StopOutcome.CONFIRMED:
        how = target.typed("reset", robot=None if robot == own else robot)
        sentence += f"; `{how}` clears it"
    elif found.outcome is StopOutcome.HEARD:
        sentence += "; watching it"
    if as_json:
        line = {
            "ok": found.outcome is StopOutcome.CONFIRMED,
            "outcome": found.outcome.value,
            "robot": robot,
            "heard_by": list(found.heard_by),
            "speed_rad_s": found.speed and found.speed.rad_s,
            "speed_m_s": found.speed and found.speed.m_s,
            "message": sentence,
        }
        print(json.dumps(line), flush=True)
    else:
        word, colon, rest = sentence.partition(":")
        say_marked(word, BOLD_RED, colon + rest)


def _warn_of_others(attempt: StopAttempt) -> None:
    target = attempt.target
    for client in attempt.clients[:1]:
        if others := target.others(client):
            warn(f"not stopped: {', '.join(others)}; `{target.typed('stop', '--all')}` stops all")


# -- stop --wait-key: a standby emergency stop for a person beside the arm ------------------------
def stop_by_key(target: RobotTarget, *, every: bool) -> None:
    """Stop the robot at every key, and when the person leaves; the session stays open meanwhile."""
    attempts, status = list[StopAttempt](), INTERRUPTED
    try:
        _watch_keys(target, attempts, every=every)
        status = 0
    finally:
        for attempt in attempts:
            attempt.end(status)


def _watch_keys(target: RobotTarget, attempts: list[StopAttempt], *, every: bool) -> None:
    with target.client(stop=True) as client, _keys() as pressed:
        connected = True

        def stop() -> None:
            client.stop()
            attempt = StopAttempt(target, client.profile, every=every)
            attempts.append(attempt)
            try:
                _watch(attempt, every=every, as_json=False)
            finally:
                attempt.over.set()

        try:
            name = target.named(client)
            client.wait_for(lambda: _connected(client), APPEAR_S)
            say(f"Every key stops {name}; so does leaving: Ctrl-C, or closing this terminal.")
            while (key := pressed()) is not False:
                if key:
                    stop()
                if connected != (connected := _connected(client)):
                    if connected:
                        say(f"Connected: every key stops {name}.")
                    else:
                        silent = f": its command node is silent; a key stops {name} if its robot "
                        say_marked("NOT CONNECTED", BOLD_RED, f"{silent}node hears it")
        finally:
            with suppress(OSError):  # the terminal may be gone
                stop()


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
