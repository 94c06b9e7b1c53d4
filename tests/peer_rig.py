"""Servers of other systems as processes of their own, and the adapters that ask them."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from camera_rig import free_endpoint, until
from model_wires import origami

from vla_zenoh.bus.session import open_session
from vla_zenoh.profile import SessionProfile

PEERS = Path(__file__).parent / "peers"
START_S = 20.0
ENVIRONMENT_S = 300
# openpi-client does not name typing-extensions, which it imports.
OPENPI_CLIENT = ("openpi-client==0.1.2", "typing-extensions")
JSON_NUMPY = ("json-numpy==2.1.1",)
MSGPACK_NUMPY = ("msgpack-numpy==0.4.8", "websockets>=15")
_PLAIN = {
    "rotation": "rpy",
    "clip": "",
    "position_scale_m": "1",
    "rotation_scale_rad": "1",
    "controller": "none",
}
_SMALL = {"size": "64x64", "dt_s": "0.1", "horizon": "4", "timeout_s": "1"}
_NO_WRIST = {
    "openpi": "observation/wrist_image=",
    "groot": "video.wrist_image=",
    "oft": "wrist_image=",
    "origami": "observation/image/wrist_right=blank:224x224",
    "xpolicylab": "vision/cam_wrist/color=",
    "lerobot_server": "observation.images.image2=",
}


@dataclass(frozen=True)
class Kind:
    """A server of `tests/peers` and the options of the adapter that fits it.

    Args:
        model: the adapter.
        script: the server.
        url: with PORT in it.
        options: of the adapter.
        variant: of the server.
    """

    model: str
    script: str
    url: str
    options: Mapping[str, str]
    variant: str = ""

    def settings(self, port: int) -> dict[str, str]:
        return {"url": self.url.replace("PORT", str(port)), **self.options}


_OPENPI = {
    "preset": "libero",
    **_PLAIN,
    **_SMALL,
    "map": _NO_WRIST["openpi"],
    "gripper_open": "high",
    "gripper_threshold": "0.5",
}
_GROOT = {"preset": "libero", **_PLAIN, **_SMALL, "map": _NO_WRIST["groot"]}
_OPENVLA = {"preset": "bridge", **_SMALL, "horizon": "1"}
KINDS: Mapping[str, Kind] = {
    "openpi": Kind("openpi", "openpi_server.py", "ws://127.0.0.1:PORT", _OPENPI),
    "vllm": Kind(
        "openpi",
        "openpi_server.py",
        "ws://127.0.0.1:PORT/v1/realtime/robot/openpi",
        _OPENPI,
        "vllm",
    ),
    "groot": Kind("groot", "groot_server.py", "tcp://127.0.0.1:PORT", _GROOT),
    "groot_n15": Kind(
        "groot", "groot_server.py", "tcp://127.0.0.1:PORT", {**_GROOT, "version": "n1.5"}, "n1.5"
    ),
    "openvla_rest": Kind("openvla_rest", "openvla_server.py", "http://127.0.0.1:PORT", _OPENVLA),
    "openvla_text": Kind(
        "openvla_rest",
        "openvla_server.py",
        "http://127.0.0.1:PORT/act",
        {**_OPENVLA, "encoded": "yes"},
        "text",
    ),
    "oft": Kind(
        "openvla_rest",
        "openvla_server.py",
        "http://127.0.0.1:PORT",
        {**_PLAIN, **_SMALL, "preset": "oft_libero", "map": _NO_WRIST["oft"]},
        "oft",
    ),
    "xpolicylab": Kind(
        "xpolicylab",
        "xpolicylab_server.py",
        "ws://127.0.0.1:PORT",
        {
            **{"preset": "joint", "case": "pick", "joint_scale_rad": "1"},
            **{"gripper": "binary", "gripper_open": "high", **_SMALL},
            "map": f"{_NO_WRIST['xpolicylab']}, state/arm_joint_state=joint, "
            "state/ee_joint_state=gripper_open",
        },
    ),
    "lerobot_server": Kind(
        "lerobot_server",
        "lerobot_server.py",
        "grpc://127.0.0.1:PORT",
        {
            **{"policy": "act", "checkpoint": "any", "preset": "libero", **_PLAIN, **_SMALL},
            **{"gripper_open": "high", "gripper_threshold": "0.5"},
            "map": _NO_WRIST["lerobot_server"],
        },
    ),
    "origami": Kind(
        "origami",
        "origami_server.py",
        "tcp/127.0.0.1:PORT",
        {"map": _NO_WRIST["origami"], "dt_s": "0.1", "timeout_s": "1"},
    ),
}
"""All of them move in metres and radians, so that a test knows how far; one camera."""
ADAPTERS = tuple(dict.fromkeys(kind.model for kind in KINDS.values()))


@dataclass
class Server:
    """A process that can be killed, stopped and started again on its port."""

    kind: Kind
    port: int
    python: str = sys.executable
    process: subprocess.Popen[bytes] | None = None
    listens: bool = True
    _all: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def settings(self) -> dict[str, str]:
        return self.kind.settings(self.port)

    def start(self, *, wait: bool = True) -> None:
        script = str(PEERS / self.kind.script)
        told = ["--port", str(self.port), f"--variant={self.kind.variant}"]
        self.process = subprocess.Popen([self.python, script, *told])
        self._all.append(self.process)
        if wait and self.listens:
            until(f"{self.kind.script} listens", self._answers, START_S)

    def _answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, f"{self.kind.script} has ended"
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def signal(self, number: int) -> None:
        assert self.process is not None
        os.kill(self.process.pid, number)

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        assert self.process is not None
        self.process.wait(5)

    def end(self) -> None:
        for process in self._all:
            if process.poll() is None:
                process.kill()
            process.wait(5)


def of(*names: str, quick: Sequence[str] | None = None) -> list[Any]:
    """Names of adapters or kinds, as parameters of a test.

    Args:
        names: of `KINDS`.
        quick: those that are not for the slow tests alone; None: all.
    """
    no_grpc = pytest.mark.skipif(find_spec("grpc") is None, reason="there is no grpcio")
    return [
        pytest.param(
            name,
            marks=[no_grpc] * (KINDS[name].model == "lerobot_server")
            + [pytest.mark.slow] * (quick is not None and name not in quick),
        )
        for name in names
    ]


@cache
def python_with(*packages: str) -> str:
    """An interpreter of an environment with these packages and nothing of ours.

    Skips the test where it cannot be had.
    """
    beside = Path(sys.executable).parent / "uv"
    uv = str(beside) if beside.is_file() else shutil.which("uv")
    if uv is None:
        pytest.skip("there is no uv")
    folder = tempfile.mkdtemp(prefix="vla-zenoh-peer-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    python = str(Path(folder) / "bin" / "python")
    for command in (
        [uv, "venv", "--quiet", "--clear", "--python", "3.11", folder],
        [uv, "pip", "install", "--quiet", "--python", python, *packages],
    ):
        made = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=ENVIRONMENT_S
        )
        if made.returncode != 0:
            pytest.skip(f"no environment with {', '.join(packages)}: {made.stderr[-300:]}")
    return python


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


@contextmanager
def served(kind: Kind, port: int | None = None, **changes: Any) -> Iterator[Server]:
    """A server, until the block ends.

    Args:
        kind: which.
        port: to listen on, or that of a router; None: any.
        changes: fields of the `Server`.
    """
    # A policy behind a router listens nowhere itself.
    server = Server(kind, port or free_port(), listens=kind.model != "origami", **changes)
    try:
        server.start()
        yield server
    finally:
        server.end()


@contextmanager
def reachable(kind: Kind, **changes: Any) -> Iterator[Server]:
    """A server and, for a policy behind a router, that too."""
    port = free_port()
    if kind.model != "origami":
        with served(kind, port, **changes) as server:
            yield server
        return
    where = (f"tcp/127.0.0.1:{port}",)
    router = SessionProfile(listen=where, connect=where)
    with open_session(router, mode="router") as session, served(kind, port, **changes) as server:
        asked = origami.request("metadata", "rig", "vla-zenoh")

        def answers() -> bool:
            replies = session.get(f"{origami.PROTOCOL}/metadata", payload=asked, timeout=1.0)
            return any(reply.ok is not None for reply in replies)

        until(f"{kind.script} answers", answers, START_S)
        yield server
