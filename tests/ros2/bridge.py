"""A real zenoh-bridge-ros2dds under test: started, killed and started again."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import zenoh
from ros_node import LOOPBACK_XML

ROOT = Path(__file__).resolve().parents[2]


def load_script() -> ModuleType:
    """scripts/ros2_bridge.py, which knows where the bridge is."""
    spec = importlib.util.spec_from_file_location(
        "ros2_bridge", ROOT / "scripts" / "ros2_bridge.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Bridge:
    """The bridge between a DDS domain and a Zenoh router.

    Args:
        program: the bridge.
        folder: for its settings and what it says.
        domain: ROS domain id.
        connect: the router; None: it is the router itself and listens at `listen`.
        listen: its own address as a router.
        settings: a file whose section for the plugin it takes; None: the plugin's own.
    """

    def __init__(
        self,
        program: Path,
        folder: Path,
        domain: int,
        *,
        connect: str | None = None,
        listen: str | None = None,
        settings: Path | None = None,
    ) -> None:
        self._program = program
        self._settings = folder / "bridge.json5"
        self.log = folder / "bridge.log"
        plugin: dict[str, Any] = {}
        if settings is not None:
            plugin = json.loads(zenoh.Config.from_file(str(settings)).get_json("plugins/ros2dds"))
        plugin |= {"domain": domain, "ros_automatic_discovery_range": "LOCALHOST"}
        config: dict[str, Any] = {
            "mode": "router" if connect is None else "client",
            "listen": {"endpoints": [listen] if listen else []},
            "connect": {"endpoints": [connect] if connect else []},
            "scouting": {"multicast": {"enabled": False}},
            "plugins": {"ros2dds": plugin},
        }
        if connect is not None:
            config["connect"] |= {
                "timeout_ms": -1,
                "exit_on_failure": False,
                "retry": {"period_init_ms": 100, "period_max_ms": 500},
            }
        self._settings.write_text(json.dumps(config))
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Bridge:
        """Start it; what it says goes to the end of `log`."""
        environment = {
            **os.environ,
            "CYCLONEDDS_URI": LOOPBACK_XML,
            "ROS_DISTRO": "jazzy",
            "RUST_LOG": os.environ.get("RUST_LOG", "info"),
        }
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, "-c", self._settings],
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        return self

    def kill(self) -> None:
        """End it as a crash would: nobody is told."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def tail(self, lines: int = 30) -> str:
        """The last it said."""
        if not self.log.exists():
            return ""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])
