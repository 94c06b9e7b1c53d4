"""Hosts that are network namespaces of this machine, joined by a switch that nothing else is on.

Each host has a name and an address of its own, its own loopback and its own /dev/shm, so that
nothing but the network joins them. Hosts named in `wires` hang on a `netns.wire`, which `Lab.shape`
makes slow or lossy; the others on a cable of the kernel's.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from netns.wire import GOOD, TUN_DEVICE, Shape

NETWORK = "10.213.0."
"""Exists inside the namespaces only."""
COMMAND_PATIENCE_S = 10.0
END_S = 6.0
SWITCH = "switch"
WIRE = Path(__file__).parent / "wire.py"
OWN_NAME = ("unshare", "--uts", "sh", "-c")


def why_not() -> str:
    """Why there can be no namespaces here, empty when there can."""
    if sys.platform != "linux":
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "only root may make network namespaces"
    if shutil.which("ip") is None:
        return "the program ip (package iproute2) is not there"
    if not os.access(TUN_DEVICE, os.R_OK | os.W_OK):
        return f"{TUN_DEVICE} is not there"
    made = subprocess.run(
        ["unshare", "--net", "--mount", "true"], capture_output=True, check=False, timeout=10
    )
    return "" if made.returncode == 0 else f"namespaces are not permitted: {made.stderr.decode()}"


needs_namespaces = pytest.mark.skipif(bool(why_not()), reason=why_not() or "-")


def _ip(*words: str, check: bool = True) -> str:
    done = subprocess.run(
        ["ip", *words], capture_output=True, text=True, timeout=COMMAND_PATIENCE_S, check=False
    )
    assert done.returncode == 0 or not check, f"ip {' '.join(words)}: {done.stderr}"
    return done.stdout


def _arguments(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    except OSError:
        return []


@dataclass
class Host:
    """One host of the lab.

    Args:
        name: of the computer.
        namespace: where it is.
        address: on the lab's network.
        device: its network device.
        environment: of all that is started here.
        python_folders: where Python looks first, here.
        processes: started here.
    """

    name: str
    namespace: str
    address: str
    device: str
    environment: dict[str, str] = field(default_factory=dict)
    python_folders: list[str] = field(default_factory=list)
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def _environment(self) -> dict[str, str]:
        path = os.pathsep.join([*self.python_folders, *sys.path])
        return {**os.environ, **self.environment, "PYTHONPATH": path}

    def words(self, *words: str) -> list[str]:
        """A command line that runs `words` on this host."""
        inside = f'mount -t tmpfs tmpfs /dev/shm && hostname {self.name} && exec "$@"'
        return ["ip", "netns", "exec", self.namespace, *OWN_NAME, inside, "sh", *words]

    def start(self, *words: str, output: Path | None = None) -> subprocess.Popen[str]:
        """Start a process here; the lab ends it at last."""
        with open(output or os.devnull, "w") as target:
            process = subprocess.Popen(
                self.words(*words),
                stdin=subprocess.DEVNULL,
                stdout=target,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
                env=self._environment(),
            )
        self.processes.append(process)
        return process

    def talk(self, *words: str) -> subprocess.Popen[str]:
        """Start a process here that is spoken to, line by line; the lab ends it at last."""
        process = subprocess.Popen(
            self.words(*words),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env=self._environment(),
        )
        self.processes.append(process)
        return process

    def pids(self) -> list[int]:
        """What runs here."""
        return list(map(int, _ip("netns", "pids", self.namespace).split()))

    def kill(self, node: str) -> float:
        """Kill a node of this kind without its notice; when, on the monotonic clock."""
        commands = {pid: _arguments(pid)[1:5] for pid in self.pids()}
        found = [p for p, c in commands.items() if c[:2] == ["-m", "vla_zenoh"] and node in c[2:]]
        assert found, f"no {node} runs on {self.name}"
        killed_s = time.monotonic()
        for pid in found:
            os.kill(pid, signal.SIGKILL)
        return killed_s

    def run(self, *words: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        """Run a command here to its end."""
        return subprocess.run(
            self.words(*words),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env={**self._environment(), "COLUMNS": "200", "NO_COLOR": "1"},
        )

    def ask(self, program: Path, *arguments: str, timeout_s: float = 60.0) -> Any:
        """Run a Python program here that prints JSON on its last line; returns that."""
        done = self.run(sys.executable, str(program), *arguments, timeout_s=timeout_s)
        assert done.returncode == 0, f"{program.name} {arguments}: {done.stdout}\n{done.stderr}"
        return json.loads(done.stdout.strip().splitlines()[-1])

    def crash(self) -> float:
        """Kill everything that runs here at once, as if the power went; when that was."""
        found = self.pids()
        killed_s = time.monotonic()
        for pid in found:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return killed_s

    def end(self, process: subprocess.Popen[str], number: int = signal.SIGINT) -> int:
        """End a process of this host, as Ctrl-C would."""
        if process.poll() is None:
            os.killpg(process.pid, number)
        try:
            return process.wait(END_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.wait(END_S)


class Lab:
    """See the module.

    Args:
        names: of the hosts; the first has the address ``.1``, and so on.
        wires: those of them whose link can be shaped.
    """

    def __init__(self, names: Sequence[str], wires: Sequence[str] = ()) -> None:
        self._mark = f"vz{os.getpid() % 100000}"
        self.hosts = {
            name: Host(name, f"{self._mark}-{name}", f"{NETWORK}{at}", f"vz{at}")
            for at, name in enumerate(names, start=1)
        }
        self._switch = f"{self._mark}-{SWITCH}"
        self._wires: dict[str, subprocess.Popen[str] | None] = dict.fromkeys(wires)

    def __getitem__(self, name: str) -> Host:
        return self.hosts[name]

    def build(self) -> None:
        """Make namespaces, cables and addresses."""
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "bridge0", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge0", "up")
        for host in self.hosts.values():
            space, port = host.namespace, f"p{host.device}"
            _ip("netns", "add", space)
            _ip("-n", space, "link", "set", "lo", "up")
            if host.name in self._wires:
                self._wires[host.name] = self._draw_wire(host, port)
            else:
                _ip(
                    *("-n", self._switch, "link", "add", port, "type", "veth"),
                    *("peer", "name", host.device, "netns", space),
                )
            _ip("-n", self._switch, "link", "set", port, "master", "bridge0", "up")
            _ip("-n", space, "addr", "add", f"{host.address}/24", "dev", host.device)
            _ip("-n", space, "link", "set", host.device, "up")

    def _draw_wire(self, host: Host, port: str) -> subprocess.Popen[str]:
        wire = subprocess.Popen(
            ["ip", "netns", "exec", self._switch, sys.executable, str(WIRE), host.device, port],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert wire.stdout is not None
        assert wire.stdout.readline().strip() == "ready"
        _ip("-n", self._switch, "link", "set", host.device, "netns", host.namespace)
        return wire

    def remove(self) -> None:
        """End what still runs, and take everything down."""
        for host in self.hosts.values():
            for process in host.processes:
                if process.poll() is None:
                    host.end(process, signal.SIGKILL)
                for pipe in filter(None, (process.stdin, process.stdout)):
                    with suppress(OSError):
                        pipe.close()
        for wire in self._wires.values():
            if wire is not None:
                wire.kill()
                wire.communicate()
        for space in (*(host.namespace for host in self.hosts.values()), self._switch):
            _ip("netns", "del", space, check=False)

    def shape(self, name: str, shape: Shape = GOOD) -> list[dict[str, int]]:
        """From now on do this to a host's frames; how many were carried and lost, each way."""
        wire = self._wires[name]
        assert wire is not None
        assert wire.stdin is not None
        assert wire.stdout is not None
        wire.stdin.write(f"{shape.to_json()}\n")
        wire.stdin.flush()
        return json.loads(wire.stdout.readline())

    def set_mtu(self, name: str, mtu: int = 1500) -> None:
        """What a host takes for the largest packet of its link."""
        host = self.hosts[name]
        _ip("-n", host.namespace, "link", "set", host.device, "mtu", str(mtu))

    def cut(self, name: str, *, cable: bool = True) -> None:
        """Pull a host's cable, or with ``cable=False`` plug it in again."""
        host = self.hosts[name]
        _ip("-n", self._switch, "link", "set", f"p{host.device}", "down" if cable else "up")


@contextmanager
def lab(*names: str, wires: Sequence[str] = ()) -> Iterator[Lab]:
    """Hosts of these names while the block lasts."""
    made = Lab(names, wires)
    try:
        made.build()
        yield made
    finally:
        made.remove()


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for certificates and profiles."""
    with tempfile.TemporaryDirectory(prefix="vla-zenoh-lab-") as folder:
        yield Path(folder)
