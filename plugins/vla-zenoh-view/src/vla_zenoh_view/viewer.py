"""Starts Rerun's viewer as a process: a window, or a server for browsers."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.cli.loopback import free_port

READY_PATIENCE_S = 30.0
CLOSE_PATIENCE_S = 5.0
POLL_S = 0.05
HERE = "127.0.0.1"
MEMORY = "25%"
"""Memory limit of the data that a server keeps for browsers that connect later."""


@dataclass(slots=True)
class Viewer:
    """A running viewer. `page_url`: for a browser; empty for a window."""

    data_url: str
    page_url: str
    process: subprocess.Popen[bytes] = field(repr=False)

    @property
    def closed(self) -> bool:
        """Whether the viewer was closed or has died."""
        return self.process.poll() is not None

    def close(self) -> None:
        """Terminate the viewer if it is running."""
        self.process.terminate()
        try:
            self.process.wait(CLOSE_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def open_window(*more: str) -> Viewer:
    """Open Rerun's viewer on this computer's screen.

    Args:
        more: arguments of its program; with ``--headless`` it needs a Vulkan driver, not a screen.

    Raises:
        NodeError: there is no screen, or the viewer does not start.
    """
    screen = "--headless" in more or sys.platform != "linux"
    if not screen and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise NodeError(
            "there is no screen here (neither DISPLAY nor WAYLAND_DISPLAY is set); look with a "
            "browser: --serve, or write a file for later: -o FILE.rrd"
        )
    port = free_port()
    arguments = ("--bind", HERE, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
    return Viewer(_data_url(HERE, port), "", _start((*arguments, *more), HERE, port))


def open_server(address: str, port: int) -> Viewer:
    """Serve Rerun's viewer for browsers.

    Args:
        address: of this computer to bind to; 0.0.0.0 for all.
        port: of the page; the data use the next port.

    Raises:
        NodeError: a port is taken, or the server does not start.
    """
    for each in (port, port + 1):
        _check_port_free(address, each)
    arguments = (
        *("--serve-web", "--bind", address, "--port", str(port + 1)),
        *("--web-viewer-port", str(port), "--server-memory-limit", MEMORY),
    )
    shown = socket.gethostname() if address in ("0.0.0.0", "::") else address
    local = HERE if address in ("0.0.0.0", "::") else address
    process = _start(arguments, local, port + 1)
    page = f"http://{shown}:{port}/?url={_data_url(shown, port + 1).replace('+', '%2B')}"
    return Viewer(_data_url(local, port + 1), page, process)


def _data_url(host: str, port: int) -> str:
    return f"rerun+http://{host}:{port}/proxy"


def _program() -> Path:
    import rerun_cli

    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def _start(arguments: Sequence[str], host: str, port: int) -> subprocess.Popen[bytes]:
    # Rerun sends usage data, unless configured otherwise or on a CI machine.
    quiet = {"CI": "true", "RUST_LOG": os.environ.get("RUST_LOG", "error")}
    process = subprocess.Popen(
        [str(_program()), *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        env={**os.environ, **quiet},
        start_new_session=True,  # Ctrl-C reaches this process alone, which sends the last data
    )
    end_s = time.monotonic() + READY_PATIENCE_S
    while process.poll() is None and time.monotonic() < end_s:
        try:
            with socket.create_connection((host, port), timeout=POLL_S):
                return process
        except OSError:
            time.sleep(POLL_S)
    process.kill()
    process.wait()
    raise NodeError(
        f"Rerun's viewer did not start (exit code {process.returncode}); its output is above. "
        "Look with a browser: --serve, or write a file for later: -o FILE.rrd"
    )


def _check_port_free(address: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except (OSError, OverflowError) as error:
            raise NodeError(
                f"{address}:{port} cannot be listened at ({error}); choose --bind and --port "
                "(the page; the data are at the next port)"
            ) from error
