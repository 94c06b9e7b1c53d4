"""The node `rolling`: a ring of the last minutes on disk, and a log of settings.

Everything but raw images goes into short MCAP files, of which the oldest are deleted. At a stop, a
fault, a rejected activation or a put on `save` the files are kept in a folder of their own, some
seconds later, so that what followed is in them. Settings, with the session that put them, and what
the command node made of them go into the log at once.

Whatever the disk does, the node goes on: it says so, counts what is missing, and tries again.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, RecordingError
from vla_zenoh.keys import ROLLING, last_chunk
from vla_zenoh.lab.rate_limit import RateLimit
from vla_zenoh.lab.recording.recorder import COMMIT_S, SWITCH_INTERVAL_S, WRITE_S, recorded_keys
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.lab.recording.sample_queue import SampleQueue
from vla_zenoh.lab.recording.writer import CLOCK_SET, RecordingWriter
from vla_zenoh.profile import Profile, to_yaml
from vla_zenoh.types import MAX_TEXT, Event, NodeStatus
from vla_zenoh_rolling.ring import PART, Ring, RingLimits, delete_oldest_saved
from vla_zenoh_rolling.settings_log import SettingsLog, logs_of

NICE = 10
"""Of the thread that writes: everything that moves the arm goes first. Zenoh's threads, which begin
before it, keep their priority: a router closes the link of a client that does not take samples."""
QUEUE_BYTES, QUEUE_SAMPLES = 64 * 1024 * 1024, 50_000
APART_S = 60.0
"""Between two automatic savings for rejected activations: a person who tries again and again."""
AGAIN_S = 5.0
"""After the disk was full."""
KEPT_SAVED = 20
"""Automatically saved folders; those that a person asked for are never deleted."""
MAX_CLIENTS = 1024
BURST, RATE_HZ = 256, 5.0
"""Lines of one key at once, and per second in the long run: who floods one key does not push out
what the log has of others."""
LOST_EVERY_S = 5.0
"""Between two lines that say how many puts were not logged."""
STOPS = {"stopped": "stop", "fault": "fault"}
"""State that was entered -> word in the name of the folder, the one of a put on `stop`."""
REFUSED = "activate_refused"
ENDED = "ended"
SEGMENT_WORDS = re.compile(r"[^A-Za-z0-9]+")


USUAL = RingLimits()


class RollingRecord:
    """The node `rolling`: keeps a ring of recordings on disk and writes the log of settings.

    Args:
        session: an open session; the caller closes it.
        folder: of the record: ``ring/``, ``saved/`` and the log.

    Raises:
        RecordingError: the folder cannot be used.
    """

    def __init__(
        self, profile: Profile, session: zenoh.Session, folder: Path, limits: RingLimits = USUAL
    ) -> None:
        self.node = Node(ROLLING, profile, session)
        self._profile, self._folder, self._limits = profile, folder, limits
        self._log = SettingsLog(folder)
        self._ring = Ring(folder / "ring", limits)
        for part in (folder / "saved").glob(f"*{PART}"):
            shutil.rmtree(part, ignore_errors=True)
        self._queue = SampleQueue(session, max_bytes=QUEUE_BYTES, max_samples=QUEUE_SAMPLES)
        self._writer: RecordingWriter | None = None
        self._path = Path()
        self._began_s = self._committed_s = self._try_s = 0.0
        self._seen_drops: Counter[str] = Counter()
        self._seen_lost: Counter[str] = Counter()
        self._arrived: Counter[str] = Counter()
        self._why = self._log_why = ""
        self._lost: Counter[str] = Counter()
        self._lost_s = 0.0
        self._settings: set[str] = set()
        self._allowances: dict[str, RateLimit] = {}
        self._clients: Bounded[str, tuple[str, str, str]] = Bounded(MAX_CLIENTS)
        self._reasons: list[str] = []
        self._save_s, self._asked, self._refused_s = 0.0, False, -1e9
        self._saved = ""

    # -- life ---------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        with suppress(OSError):
            os.nice(NICE)
        self._note_beginning()
        keys = self.node.keys
        settings = (keys.prompt, keys.active, keys.worker, keys.rate, keys.speed, keys.slower)
        held = [keys.of_part(part).held for part in self._profile.parts] or [keys.held]
        orders = (keys.stop, keys.reset, keys.save, keys.sim_reset)
        self._settings = {*settings, *held, *orders}
        self.node.follow_senders()
        self._queue.subscribe(recorded_keys(keys), settings=keys.full("*"))
        for expression in recorded_keys(keys):
            self.node.reception.watch(expression, self._queue.arrived)
        while not stop.wait(WRITE_S):
            self.step()
        self.close()

    def step(self) -> None:
        """One round: the log first, then the ring, then what is to be saved."""
        if step_s := self.node.adopt_system_time():
            self._add("clock", step_s=round(step_s, 3))
        samples = self._queue.take()
        self._count(samples)
        self._note(samples)
        self._write_log()
        self._write_samples(samples)
        now_s = time.monotonic()
        if self._save_s and now_s >= self._save_s:
            self._save()
        self._report()

    def close(self) -> None:
        """Write what there is, and leave."""
        self.node.reception.unwatch(self._queue.arrived)
        self._queue.close()
        self.step()
        if self._reasons:
            self._save()
        self._finish_segment()
        self._note_lost()
        self._add(ENDED)
        self._write_log()
        self._log.close()
        self.node.publish_end(self._detail())
        self.node.close()

    def _note_beginning(self) -> None:
        last = self._log.last_what
        if last not in ("", ENDED):
            self._add("after_gap", why="the record before this one was killed, or lost its power")
        profile = to_yaml(self._profile)
        self._add(
            "began",
            robot=self._profile.robot.name,
            profile=self._profile.name,
            profile_sha256=hashlib.sha256(profile.encode()).hexdigest(),
            host=socket.gethostname(),
            pid=os.getpid(),
        )
        self._write_log()

    @property
    def _set_ns(self) -> int:
        """By how much the wall clock was set since the clock of reception began."""
        return self.node.clock.offset_ns - self._queue.clock.offset_ns

    # -- the log ------------------------------------------------------------------------------
    def _add(self, what: str, wall_ns: int | None = None, **facts: Any) -> None:
        self._log.add(what, self.node.clock.wall_ns() if wall_ns is None else wall_ns, **facts)

    def _note(self, samples: list[Sample]) -> None:
        keys = self.node.keys
        while self._queue.deletions:
            key = self._queue.deletions.popleft()
            if key in self._settings:
                self._note_setting(Sample(key, b"", "", None, self._queue.clock.wall_ns()), True)
        for sample in samples:
            if sample.key in self._settings:
                self._note_setting(sample)
            elif sample.key == keys.event("command"):
                self._note_event(sample)
            elif sample.key.startswith(keys.status("router")):
                self._note_clients(sample)
        if self._lost and time.monotonic() - self._lost_s > LOST_EVERY_S:
            self._note_lost()

    def _may_note(self, key: str) -> bool:
        now_s = time.monotonic()
        limit = self._allowances.setdefault(key, RateLimit(RATE_HZ, BURST, now_s))
        if limit.take(now_s):
            return True
        self._lost[key] += 1
        return False

    def _note_lost(self) -> None:
        self._lost_s = time.monotonic()
        for key, count in self._lost.items():
            self._add("lost", key=self.node.keys.short(key), puts=count)
        self._lost.clear()

    def _note_setting(self, sample: Sample, deleted: bool = False) -> None:
        if not self._may_note(sample.key):
            return
        name = self.node.keys.short(sample.key)
        text = sample.payload[: 4 * MAX_TEXT].decode("utf-8", "replace")[:MAX_TEXT]
        facts: dict[str, Any] = {"key": name, "text": text, "client": sample.client}
        if len(sample.payload) > 4 * MAX_TEXT:
            facts["bytes"] = len(sample.payload)
        if deleted:
            facts["deleted"] = True
        self._add("put", sample.received_ns + self._set_ns, **facts)
        if deleted:
            return
        if name == "save":
            self._want(f"asked: {text}"[:MAX_TEXT], asked=True)
        elif name == "stop":
            self._want("stop")

    def _note_event(self, sample: Sample) -> None:
        try:
            event = records.decode(Event, sample.payload)
        except CodecError:
            return
        refused = event.kind == "refusal" and event.what.endswith("_refused")
        if (event.kind != "transition" and not refused) or not self._may_note(sample.key):
            return
        self._add("command", sample.received_ns + self._set_ns, event=event.what, why=event.why)
        if why := STOPS.get(event.what.rpartition("->")[2]):
            self._want(why)
            return
        # One that only waits for what is starting is tried again, and no incident.
        incident = event.what == REFUSED and event.level != "info"
        if incident and time.monotonic() - self._refused_s > APART_S:
            self._refused_s = time.monotonic()
            self._want("activation refused")

    def _note_clients(self, sample: Sample) -> None:
        """Which certificate and address a session has, as its router says."""
        try:
            found = records.decode(NodeStatus, sample.payload).detail.get("clients")
        except CodecError:
            return
        router = last_chunk(sample.key)
        for number, told in found.items() if isinstance(found, dict) else ():
            if not (isinstance(told, (list, tuple)) and len(told) == 2):
                continue
            certificate, address = map(str, told)
            known = (router, certificate, address)
            if self._clients.get(number) != known and self._may_note(sample.key):
                self._clients[number] = known
                self._add(
                    "client", client=number, certificate=certificate, address=address, by=router
                )

    def _write_log(self) -> None:
        try:
            self._log.write()
        except RecordingError as error:
            self._fault("log_failed", self._log_why, str(error))
            self._log_why = str(error)
            return
        if self._log_why:
            self._log_why = ""
            self._add("disk", why="the log could not be written for a while")
        if self._log.lost:
            self._add("lost", lines=self._log.lost)
            self._log.lost = 0

    # -- the ring -----------------------------------------------------------------------------
    def _count(self, samples: list[Sample]) -> None:
        """Samples that never arrived leave a gap in the numbers of their key."""
        for sample in samples:
            if sample.header is not None:
                self._arrived[sample.key] += 1
                arrived = self._arrived[sample.key] + self._queue.dropped[sample.key]
                self.node.traffic.received(sample.key, sample.header, arrived)

    def _write_samples(self, samples: list[Sample]) -> None:
        now_s = time.monotonic()
        try:
            if self._writer is None:
                if now_s < self._try_s:
                    self.node.counters["missed"] += len(samples)
                    return
                self._begin_segment(now_s)
            assert self._writer is not None
            for sample in samples:
                self._writer.write(sample)
            if now_s - self._committed_s >= COMMIT_S:
                self._committed_s = now_s
                self._writer.commit()
            most = self._limits.max_bytes // 20
            if now_s - self._began_s >= self._limits.segment_s or self._writer.size > most:
                self._finish_segment()
        except RecordingError as error:
            self._disk_failed(str(error), len(samples))

    def _begin_segment(self, now_s: float) -> None:
        self._path = self._ring.next_path()
        self._writer = RecordingWriter(
            self._path,
            self.node.keys,
            profile_yaml=to_yaml(self._profile),
            base_frame=self._profile.robot.base_frame,
            began_ns=self.node.clock.wall_ns(),
            about={
                "profile": self._profile.name,
                "host": socket.gethostname(),
                CLOCK_SET: str(self._set_ns),
            },
        )
        self._began_s = self._committed_s = now_s
        if self._why:
            self._why = ""
            self._add("disk", why="nothing was recorded for a while")

    def _finish_segment(self) -> None:
        writer, self._writer = self._writer, None
        if writer is None:
            return
        dropped, lost = Counter(self._queue.dropped), Counter(self.node.traffic.lost)
        missing = {"dropped": dropped - self._seen_drops, "lost": lost - self._seen_lost}
        self._seen_drops, self._seen_lost = dropped, lost
        for what, new in missing.items():
            if new:
                self._add(what, samples={self.node.keys.short(key): new[key] for key in new})
        try:
            writer.finish(missing)
        except RecordingError as error:
            self._disk_failed(str(error), 0)
        count = sum(new.total() for new in missing.values())
        self._ring.add(self._path, time.monotonic() - self._began_s, count)

    def _disk_failed(self, why: str, samples: int) -> None:
        """Say so, make room where that is ours to make, and try again soon."""
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None
            self._ring.add(self._path, time.monotonic() - self._began_s)
        elif self._path.exists() and not self._path.stat().st_size:  # it could not even begin
            self._path.unlink()
        self._ring.drop_oldest()
        self.node.counters["missed"] += samples
        self._try_s = time.monotonic() + AGAIN_S
        self._fault("recording_failed", self._why, why)
        self._why = why

    def _fault(self, what: str, before: str, why: str) -> None:
        if why != before:
            self.node.emit(Event("error", "fault", what, why[:1000]))

    # -- saving -------------------------------------------------------------------------------
    def _want(self, why: str, *, asked: bool = False) -> None:
        if why not in self._reasons:
            self._reasons.append(why)
        self._asked = self._asked or asked
        self._save_s = self._save_s or time.monotonic() + self._limits.after_s

    def _save(self) -> None:
        reasons, asked = self._reasons, self._asked
        self._reasons, self._asked, self._save_s = [], False, 0.0
        self._finish_segment()
        word = SEGMENT_WORDS.sub("-", reasons[0])[:40].strip("-") or "saved"
        saved = self._folder / "saved"
        folder = _new_folder(saved, f"{time.strftime('%Y%m%d-%H%M%S')}-{word}")
        facts = {"reasons": reasons, "asked": asked}
        try:
            self._write_log()
            count = self._ring.save(folder, logs_of(self._folder), facts)
        except RecordingError as error:
            self._add("not_saved", reasons=reasons, why=str(error))
            self._fault("not_saved", "", f"the rolling record was not saved: {error}")
            return
        self._saved = str(folder)
        self._add("saved", folder=folder.name, reasons=reasons, segments=count)
        missing = self._ring.missing
        but = f", but for {missing} samples that never arrived or did not fit" if missing else ""
        said = f"the last {self._ring.seconds:.0f} s{but} are in {folder}: {'; '.join(reasons)}"
        self.node.emit(Event("info", "notice", "saved", said[:1000]))
        for gone in delete_oldest_saved(saved, KEPT_SAVED):
            self._add("deleted", folder=gone.name)

    # -- out ----------------------------------------------------------------------------------
    def _detail(self) -> dict[str, Any]:
        size = 0 if self._writer is None else self._writer.size
        return {
            "folder": str(self._folder),
            "seconds": round(self._ring.seconds, 1),
            "size_bytes": self._ring.size_bytes + size,
            "missing": self._ring.missing,
            "saved": self._saved,
            "why": self._why or self._log_why,
        }

    def _report(self) -> None:
        state = "failed" if self._why or self._log_why else "recording"
        if not self.node.status_due(state):
            return
        self.node.counters["dropped"] = self._queue.dropped.total()
        self.node.counters["lost"] = self.node.traffic.lost.total()
        self.node.publish_status(state, detail=self._detail())


def _new_folder(parent: Path, name: str) -> Path:
    """One that is not there yet: two savings in a second, or a clock that was set back."""
    folder, number = parent / name, 1
    while folder.exists():
        number += 1
        folder = parent / f"{name}-{number}"
    return folder
