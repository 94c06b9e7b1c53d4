"""Processes of a benchmark: how its servers are started, watched, timed and ended.

Run as a module it is such a process: ``peer NAME PORT [SECONDS]``, ``router ENDPOINT``,
``echo ENDPOINT listen|connect CAMERAS``, ``robot PROFILE_FILE``,
``follower PROFILE_FILE`` or ``plain PLAN_FILE``.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

from benchmarks import peers
from vla_zenoh.errors import NodeError
from vla_zenoh.runtime.process import PARENT_VARIABLE, die_with_parent, stop_on_signals

CHECKOUT = Path(__file__).resolve().parents[2]
START_PATIENCE_S = 20.0
END_PATIENCE_S = 2.0
POLL_S = 0.02


def free_port() -> int:
    """A free TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Server:
    """One server process, up while the context lasts.

    Args:
        arguments: as in the module's own text.
    """

    def __init__(self, *arguments: str) -> None:
        self._arguments = arguments
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Its process number."""
        assert self._process is not None
        return self._process.pid

    def __enter__(self) -> Server:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.chain.process", *self._arguments],
            cwd=CHECKOUT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env={**os.environ, PARENT_VARIABLE: str(os.getpid())},
            start_new_session=True,
        )
        return self

    def await_port(self, port: int) -> None:
        """Wait until it listens there.

        Raises:
            NodeError: it does not, or has ended.
        """
        give_up = time.monotonic() + START_PATIENCE_S
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            self.check()
            if time.monotonic() > give_up:
                raise NodeError(f"{' '.join(self._arguments)} does not listen on port {port}")
            time.sleep(POLL_S)

    def check(self) -> None:
        """Check that it is alive.

        Raises:
            NodeError: it has ended; its output is on stderr.
        """
        assert self._process is not None
        if self._process.poll() is not None:
            raise NodeError(
                f"the benchmark's process {' '.join(self._arguments)!r} ended with "
                f"{self._process.returncode}; its output is above"
            )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process is not None
        self._process.terminate()
        try:
            self._process.wait(END_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main(arguments: list[str]) -> None:
    """Run the process that `arguments` name."""
    role, *rest = arguments
    if role == "peer":
        name, port, takes_s = (*rest, "0")[:3]
        # Ctrl-C reaches the parent alone, which ends this one by SIGTERM: that is no error.
        signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
        die_with_parent()
        peers.load(name).serve(int(port), float(takes_s))
        return
    stop = stop_on_signals()
    die_with_parent()
    if role == "router":
        from benchmarks.chain.echo import session_at

        with session_at(rest[0], listen=True):
            stop.wait()
    elif role == "echo":
        from benchmarks.chain.echo import serve

        endpoint, how, cameras = rest
        serve(endpoint, int(cameras), listen=how == "listen", stop=stop)
    elif role in ("robot", "follower"):
        from benchmarks.chain.robot import play_robot

        play_robot(rest[0], stop, follows=role == "follower")
    elif role == "plain":
        from benchmarks.rest import play_plain

        play_plain(rest[0], stop)
    else:
        raise NodeError(f"{role!r} is no part of a benchmark")


if __name__ == "__main__":
    main(sys.argv[1:])
