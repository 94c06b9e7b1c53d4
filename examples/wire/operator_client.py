"""An operator in plain Python: lets the arm do a task while this program lives.

    python examples/wire/operator_client.py ENDPOINT ROBOT WORKER PROMPT SECONDS

Ctrl-C is an emergency stop; `put <robot>/reset ""` clears it.
"""

import sys
import time

import zenoh
from plain_node import Rejected, open_session, read

HOLDER = "plain-operator"
PATIENCE_S = 5.0


class Watch:
    """The newest task, and what is printed of events."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.task: dict = {}
        self._task = session.declare_subscriber(f"{robot}/task", self._take_task)
        self._events = session.declare_subscriber(f"{robot}/event/command", self._show)

    def _take_task(self, sample: zenoh.Sample) -> None:
        try:
            _, self.task = read(sample)
        except Rejected as rejected:
            print("task:", rejected)

    def _show(self, sample: zenoh.Sample) -> None:
        try:
            _, event = read(sample)
        except Rejected as rejected:
            print("event:", rejected)
            return
        print(f"{event['level']}: {event['what']} {event.get('why', '')}")

    def wait(self, seconds: float, **wanted: object) -> bool:
        """Whether the task has these values in time."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            if wanted and wanted.items() <= self.task.items():
                return True
            time.sleep(0.02)
        return False


def main(
    endpoint: str = "tcp/127.0.0.1:7447",
    robot: str = "vla/panda",
    worker: str = "scripted",
    prompt: str = "HARD: go up x10",
    seconds: str = "5",
) -> None:
    """Set the task, activate, and deactivate in the end."""
    with open_session(endpoint) as session:
        watch = Watch(session, robot)
        session.put(f"{robot}/worker", worker)
        session.put(f"{robot}/prompt", prompt)
        if not watch.wait(PATIENCE_S, worker=worker, prompt=prompt):
            sys.exit("the command node does not take the task")
        deadman = session.liveliness().declare_token(f"{robot}/holding/{HOLDER}")
        session.put(f"{robot}/active", f"true while {HOLDER}")
        if not watch.wait(PATIENCE_S, active=True):
            sys.exit("the arm was not activated: the events say why")
        try:
            if watch.wait(float(seconds), active=False):
                sys.exit("the arm was deactivated: the events say why")
        except KeyboardInterrupt:
            session.put(f"{robot}/stop", "")
        session.put(f"{robot}/active", "false")
        deadman.undeclare()


if __name__ == "__main__":
    main(*sys.argv[1:])
