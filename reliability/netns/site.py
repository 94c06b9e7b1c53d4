"""A lab with certificates on hosts that are namespaces, made by the commands a person would use."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from netns.lab import Lab, lab, scratch

from vla_zenoh.security.store import Store

HERE = Path(__file__).parent
DRIVE_S = 120.0
LINES_SHOWN = 3000
COMPILE_S = 60.0


def compiler() -> str | None:
    """A C compiler, for hosts that have a wall clock of their own."""
    return shutil.which("cc") or shutil.which("gcc")


@dataclass
class Site:
    """The lab.

    Args:
        hosts: the namespaces.
        folder: everything's.
        store: of the authority, which no host has.
    """

    hosts: Lab
    folder: Path
    store: Store

    @property
    def secured(self) -> Path:
        return self.folder / "plain_secure.yaml"

    def profile(self, host: str) -> Path:
        return self.folder / host / "lab.yaml"

    def vla(self, host: str, *words: str, timeout_s: float = 60.0) -> str:
        """Run ``vla-zenoh`` on a host; returns its output."""
        done = self.hosts[host].run(sys.executable, "-m", "vla_zenoh", *words, timeout_s=timeout_s)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def add(self, host: str, role: str) -> None:
        """Give people at a computer a role."""
        anywhere = next(iter(self.hosts.hosts))
        words = ("secure", "add", host, "--role", role, "--profile", str(self.secured))
        self.vla(anywhere, *words)

    def equip(self, *hosts: str) -> None:
        """Give hosts what a person would copy there: their own certificates and the profile."""
        for host in hosts:
            folder = self.folder / host
            shutil.copytree(self.store.folder / host, folder / "certificates" / host)
            text = self.secured.read_text()
            text = text.replace(str(self.store.folder), str(folder / "certificates"))
            text = text.replace("extends: plain", f"extends: {self.folder / 'plain.yaml'}")
            self.profile(host).write_text(text)

    def up(self, *hosts: str) -> None:
        """Start what belongs on these hosts."""
        for host in hosts:
            words = (sys.executable, "-m", "vla_zenoh", "up", str(self.profile(host)))
            self.hosts[host].start(*words, "--host", host, output=self.folder / f"{host}.log")

    @property
    def impostor_log(self) -> Path:
        """What the last one wrote."""
        return self.folder / "impostor.log"

    def impostor(self, host: str, name: str) -> None:
        """Let a computer call itself `name`, and start the part of that host with its papers."""
        words = (sys.executable, "-m", "vla_zenoh", "up", str(self.profile(name)), "--host", name)
        # A second computer has a processor of its own, and does not hold up the arm's.
        renamed = ("sh", "-c", f'hostname {name} && exec nice -n 19 "$@"', "sh", *words)
        self.hosts[host].start(*renamed, output=self.impostor_log)

    def own_clock(self, host: str) -> None:
        """Give a host a wall clock that can be set, before anything is started there."""
        library, cc = self.folder / "wall_clock.so", compiler()
        assert cc is not None
        if not library.exists():
            words = [cc, "-shared", "-fPIC", "-O2", "-o", str(library), str(HERE / "wall_clock.c")]
            subprocess.run(words, check=True, timeout=COMPILE_S)
        self._clock(host).write_bytes(bytes(8))
        self.hosts[host].environment.update(
            LD_PRELOAD=str(library), WALL_CLOCK_FILE=str(self._clock(host))
        )

    def step_clock(self, host: str, offset_s: float) -> None:
        """Set a host's clock so far from what it would be."""
        with self._clock(host).open("r+b", buffering=0) as file:  # it is mapped: not a new one
            file.write(struct.pack("=q", round(offset_s * 1e9)))

    def _clock(self, host: str) -> Path:
        return self.folder / f"{host}.clock"

    def drive(self, host: str, direction: str, count: int) -> Any:
        """Drive the arm from a host; what came of it."""
        return self.ask(host, "drive.py", direction, str(count), timeout_s=DRIVE_S)

    def ask(self, host: str, program: str, *arguments: str, timeout_s: float) -> Any:
        """Run one of the programs here on a host, with its profile; what it says.

        Raises:
            AssertionError: it fails; with the last lines of every host.
        """
        words = (str(self.profile(host)), *arguments)
        try:
            return self.hosts[host].ask(HERE / program, *words, timeout_s=timeout_s)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.logs()}") from None

    def logs(self) -> str:
        """The last lines of every host, for the message of a test that fails."""
        return "\n".join(
            f"{path.stem}:\n{path.read_text()[-LINES_SHOWN:]}"
            for path in sorted(self.folder.glob("*.log"))
        )


@contextmanager
def secured_site(
    plain: str, hosts: Sequence[str], routers: Sequence[str], wires: Sequence[str] = ()
) -> Iterator[Site]:
    """A lab whose profile is `plain`, with certificates, nothing started yet.

    Args:
        plain: the profile, all of it on loopback.
        hosts: of the network.
        routers: those that run one.
        wires: those whose link can be shaped.
    """
    with scratch() as folder, lab(*hosts, wires=wires) as made:
        (folder / "plain.yaml").write_text(plain)
        site = Site(made, folder, Store(folder / "authority"))
        places = [word for host in routers for word in ("--at", f"{host}={made[host].address}")]
        site.vla(
            hosts[0],
            *("secure", "init", "--profile", str(folder / "plain.yaml")),
            *("--output", str(site.secured), "--folder", str(site.store.folder), *places),
        )
        yield site
