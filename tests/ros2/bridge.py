"""A real zenoh-bridge-ros2dds under test: started, killed and started again."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from pathlib import Path
from types import ModuleType

from ros_node import LOOPBACK_XML
from vla_zenoh_ros2.bridge_config import bridge_config, bridge_text

from vla_zenoh.profile import load_profile

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


def generated(profile_file: Path, *, beside: bool = False, all_names: bool = False) -> str:
    """The bridge's settings as ``vla-zenoh profile bridge-config`` gives them.

    Args:
        profile_file: of a profile whose bridge is reached without certificates.
        beside: the bridge is a client of our router.
        all_names: without the list of what is let through, for tests of the bridge itself.
    """
    profile = load_profile(str(profile_file))
    config = bridge_config(profile, beside=beside)
    if all_names:
        del config["plugins"]["ros2dds"]["allow"]
    return bridge_text(profile, config)


class Bridge:
    """The bridge between a DDS domain and Zenoh.

    Args:
        program: the bridge.
        folder: for its settings and what it says.
        settings: text of its configuration.
        distribution: of ROS 2.
    """

    def __init__(
        self, program: Path, folder: Path, settings: str, distribution: str = "jazzy"
    ) -> None:
        self._program, self._distribution = program, distribution
        self._settings = folder / "bridge.json5"
        self._settings.write_text(settings)
        self.log = folder / "bridge.log"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Bridge:
        """Start it; what it says goes to the end of `log`."""
        environment = {
            **os.environ,
            "CYCLONEDDS_URI": LOOPBACK_XML,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_DISTRO": self._distribution,
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
