"""Finished runs in the folder of recordings, and the pages and films that are made of them.

Browsers name a run as the list does, so no path of theirs is ever opened. What was made is opened
by a ticket: an address that cannot be guessed, good for this one result and for a while. A
link cannot carry the token of a person, and the address of a page is no place for it.

As a program, ``python -m vla_zenoh.lab.web.runs KIND RUN OUT``, it makes one of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from vla_zenoh.errors import RecordingError, VlaZenohError
from vla_zenoh.lab.cli.output_path import RUNS
from vla_zenoh.lab.evaluation.evaluate import recordings
from vla_zenoh.lab.trial.folder import PLAN, TrialFolder
from vla_zenoh.lab.trial.unattended import PAGE
from vla_zenoh.lab.web.requests import FILM, REPORT

MADE = ".web"
"""Folder of what was made, in that of the runs."""
PART = ".part"
MAX_RUNS = 100
TICKET_S = 900.0
MAX_TICKETS = 64
MAX_FAULT = 500
NICENESS, PICTURES, EVERY = 10, 8, 15
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".mp4": "video/mp4",
    ".jpg": "image/jpeg",
    ".png": "image/png",
}
"""End of the name -> content type, of all files that are served."""
HEADERS = {
    # Plots run scripts of their own file; `sandbox` gives them an origin that has nothing of ours.
    "content-security-policy": "sandbox allow-scripts; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src 'self' data:; media-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cross-origin-resource-policy": "cross-origin",
}
"""Of everything that is served by a ticket."""


class Ticket(NamedTuple):
    """What an address opens.

    Args:
        path: a file, or the folder of a page with its pictures.
    """

    path: Path
    pictures: bool
    until_s: float


class Runs:
    """The folder of runs. Its methods may be called from several threads.

    Args:
        folder: of the recordings; it need not be there.
    """

    def __init__(self, folder: Path = RUNS) -> None:
        self._folder = folder
        self._tickets: dict[str, Ticket] = {}
        self._lock, self._making = threading.Lock(), threading.Lock()

    # -- the list -----------------------------------------------------------------------------
    def listed(self) -> list[dict[str, Any]]:
        """The newest runs, newest first: name, time, size, and what is known of each."""
        found = [(path.stat().st_mtime_ns, path) for path in self._found()]
        trials: dict[Path, _Trial] = {}
        return [
            self._row(path, at_ns, trials) for at_ns, path in sorted(found)[: -MAX_RUNS - 1 : -1]
        ]

    def _found(self) -> Iterator[Path]:
        inside = self._folder.resolve()
        pages = (page.parent for page in self._folder.glob(f"*/{PAGE}"))
        for path in (*recordings([self._folder]), *pages):
            if (
                path.exists()
                and path.resolve().is_relative_to(inside)
                and PART not in path.suffixes
            ):
                yield path

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder).as_posix()

    def _row(self, path: Path, at_ns: int, trials: dict[Path, _Trial]) -> dict[str, Any]:
        files = path.glob("*.mcap") if path.is_dir() else [path]
        if path.parent not in trials:
            trials[path.parent] = _Trial.of(path.parent)
        trial = trials[path.parent]
        return {
            "name": self._name(path),
            "at_ms": at_ns // 1_000_000,
            "mb": round(sum(file.stat().st_size for file in files) / 1e6, 1),
            "said": trial.said.get(path.name, ""),
            "closed": trial.closed,
            "page": path.is_dir() and (path / PAGE).is_file(),
        }

    def _path(self, name: str) -> Path:
        """The run that the list calls `name`.

        Raises:
            RecordingError: there is none, or its trial is blind and not finished.
        """
        path = next((each for each in self._found() if self._name(each) == name), None)
        if path is None:
            raise RecordingError(f"there is no run {name[:100]!r}: the list may be old")
        if why := _Trial.of(path.parent).closed:
            raise RecordingError(f"{name}: {why}")
        return path

    # -- making -------------------------------------------------------------------------------
    def make(self, name: str, kind: str, pictures: bool, told: Callable[[float], None]) -> str:
        """Make the page or the film of a run, unless it was made before.

        It is made by a process of its own, at low priority: decoding pictures in this one would
        hold up the echo of ticks.

        Args:
            kind: `REPORT` or `FILM`.
            told: called with the share that is done, where that is known.

        Returns:
            The address, relative to the page.

        Raises:
            RecordingError: there is no such run, it cannot be read, or another is being made.
        """
        path = self._path(name)
        if kind == REPORT and (path / PAGE).is_file():
            return self._ticket(path, pictures)
        end = ".mp4" if kind == FILM else ".html"
        stat = path.stat()
        key = f"{name} {stat.st_mtime_ns} {stat.st_size} {pictures}"
        out = self._folder / MADE / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}{end}"
        if not self._making.acquire(blocking=False):
            raise RecordingError("another page or film is being made: try again when it is done")
        try:
            if not out.exists():
                self._make(kind, path, out, pictures, told)
        finally:
            self._making.release()
        return self._ticket(out, pictures)

    def _make(
        self, kind: str, path: Path, out: Path, pictures: bool, told: Callable[[float], None]
    ) -> None:
        out.parent.mkdir(exist_ok=True)
        part = out.with_name(f"{out.stem}{PART}{out.suffix}")
        words = [kind, str(path), str(part), *(["--pictures"] if pictures else [])]
        with subprocess.Popen(
            [sys.executable, "-m", "vla_zenoh.lab.web.runs", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            assert process.stdout is not None
            last = ""
            for line in process.stdout:
                last = line.strip() or last
                try:
                    told(float(line))
                except ValueError:
                    continue
        if process.returncode:
            part.unlink(missing_ok=True)
            raise RecordingError(last[:MAX_FAULT] or f"{path} could not be read")
        part.replace(out)

    # -- tickets ------------------------------------------------------------------------------
    def _ticket(self, path: Path, pictures: bool) -> str:
        token, now_s = secrets.token_urlsafe(24), time.monotonic()
        with self._lock:
            self._tickets = {k: v for k, v in self._tickets.items() if v.until_s > now_s}
            if len(self._tickets) >= MAX_TICKETS:
                del self._tickets[next(iter(self._tickets))]
            self._tickets[token] = Ticket(path, pictures, now_s + TICKET_S)
        return f"/runs/{token}/{PAGE if path.is_dir() else ''}"

    def opened(self, token: str, rest: str) -> Path | None:
        """The file behind an address; None: there is none, or not any more."""
        with self._lock:
            ticket = self._tickets.get(token)
        if ticket is None or ticket.until_s < time.monotonic():
            return None
        path = ticket.path
        if path.is_dir():
            path = path / rest
            if not path.resolve().is_relative_to(ticket.path.resolve()):
                return None
            if not ticket.pictures and path.name != PAGE:
                return None
        elif rest:
            return None
        return path if path.suffix in KINDS and path.is_file() else None


class _Trial(NamedTuple):
    """What the folder of a run says of it.

    Args:
        closed: why its runs are not shown yet; empty: they are.
        said: name of a recording -> verdict and note.
    """

    closed: str
    said: dict[str, str]

    @staticmethod
    def of(folder: Path) -> _Trial:
        trial = TrialFolder(folder)
        if not (folder / PLAN).is_file():
            return _Trial("", {})
        try:
            plan, episodes = trial.plan(), trial.episodes()
        except (RecordingError, json.JSONDecodeError) as error:
            return _Trial(str(error), {})
        said = {each.recording: f"{each.verdict} {each.note}".strip() for each in episodes}
        blind = plan is not None and plan.blind and plan.next_due(episodes) is not None
        return _Trial("its trial is blind and not finished" if blind else "", said)


def make_file(kind: str, run: Path, out: Path, *, pictures: bool) -> None:
    """Make it, and print the share that is done.

    Raises:
        RecordingError: the run cannot be read, or has no pictures.
    """
    if kind == FILM:
        from vla_zenoh.lab.recording.film import Film, write_film
        from vla_zenoh.lab.recording.run import load_run

        def told(done: int, total: int) -> None:
            if done % EVERY == 0:
                print(f"{done / total:.2f}", flush=True)

        if not write_film(out, load_run(run), Film(), progress=told):
            raise RecordingError(f"{run.name} has no pictures of cameras")
        return
    from vla_zenoh.lab.evaluation.evaluate import evaluate
    from vla_zenoh.lab.evaluation.report import page

    runs, faults = evaluate([run], pictures=PICTURES if pictures else 0)
    if not runs:
        raise RecordingError("; ".join(faults.values()))
    out.write_text(page(runs, faults), "utf-8")


if __name__ == "__main__":
    os.nice(NICENESS)
    kind, run, out = sys.argv[1:4]
    try:
        make_file(kind, Path(run), Path(out), pictures="--pictures" in sys.argv)
    except VlaZenohError as error:
        sys.exit(str(error))
