"""A flight recorder: what the simulator and the command node say, written down where they say it.

Python imports this file at its start, where its folder is on PYTHONPATH. Between an arm and whoever
watches it there is a network that may be down, and what is measured of a fault must not depend on
it. So `state/pose` and `command/pose` are kept in files beside their writers, in the folder that
FLIGHT_FOLDER names, with when each of the two last heard the other: one row of float64 a record,
see `netns.flight_log`. Of a robot of the parts that FLIGHT_PARTS names these are the joints of each
part, measured and commanded; and of what the file ``blocked`` names ("SHARE KEY") that share of the
records is not sent.
"""

from __future__ import annotations

import os
import random
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

RECORDED = {"sim": "state/pose", "command": "command/pose"}
JOINTS = {"sim": "state/joint", "command": "command/joint"}
APPENDING = os.O_WRONLY | os.O_CREAT | os.O_APPEND


def _note_commands(heard_s: list[float]) -> None:
    """Of the simulator: whenever its guard takes a command."""
    from vla_zenoh.guard.stream_guard import CommandStream

    take = CommandStream.take

    def take_and_note(self: CommandStream[Any], command: Any) -> None:
        heard_s[0] = time.monotonic()
        take(self, command)

    CommandStream.take = take_and_note


def _note_states(heard_s: list[float]) -> None:
    """Of the command node: whenever the arm's pose has come."""
    from vla_zenoh.nodes.command.inputs import CommandInputs

    take = CommandInputs.poll

    def take_and_note(self: CommandInputs, now_ns: int, **named: Any) -> Any:
        inputs = take(self, now_ns, **named)
        if inputs.pose is not None:
            heard_s[0] = time.monotonic()
        return inputs

    CommandInputs.poll = take_and_note


def _record(key: str, published: Any) -> Any:
    """The record that was published on `key`, which may have been encoded before."""
    from vla_zenoh import types
    from vla_zenoh.codec import records

    kinds = {
        "state/pose": types.PoseState,
        "command/pose": types.PoseCommand,
        "state/joint": types.JointState,
        "command/joint": types.JointCommand,
    }
    kind = kinds["/".join(key.split("/")[-2:])]
    return records.decode(kind, published) if isinstance(published, bytes) else published


def _install(node: str, path: str) -> None:
    import numpy as np

    from vla_zenoh.bus.node import Publisher

    key_end, heard_s = RECORDED[node], [float("nan")]
    (_note_commands if node == "sim" else _note_states)(heard_s)
    put = Publisher.publish
    file = os.open(path, APPENDING)  # as long as the process lives

    def put_and_keep(self: Publisher, record: Any, **named: Any) -> Any:
        header = put(self, record, **named)
        if self.key.endswith(key_end):
            record = _record(self.key, record)
            if key_end == RECORDED["sim"]:
                reference = record.reference_position_m
                parts, asked_ns = (record.position_m, record.twist, reference), None
            else:
                parts = (record.position_m, record.twist, record.acceleration[:3])
                asked_ns = None if record.cause is None else record.cause.received_ns
            # The computer's own clock, which nobody sets.
            at_s, asked_s = (
                np.nan if stamp_ns is None else (stamp_ns - self._clock.offset_ns) / 1e9
                for stamp_ns in (header.stamp_wall_ns, asked_ns)
            )
            # By its age: a clock that is set in between does not make it older.
            silent_s = time.monotonic() - heard_s[0]
            os.write(file, np.concatenate([[at_s], *parts, [asked_s, at_s - silent_s]]).tobytes())
        return header

    Publisher.publish = put_and_keep


class _Nowhere:
    """In place of Zenoh's publisher: what is put is lost."""

    def put(self, *_: Any, **__: Any) -> None:
        pass


def _install_parts(node: str, folder: Path, parts: list[str]) -> None:
    import numpy as np

    from vla_zenoh.bus.node import Publisher

    put, nowhere = Publisher.publish, _Nowhere()

    @cache
    def file_of(part: str) -> int:
        return os.open(folder / f"{part}.{node}.joints", APPENDING)

    def lost(key: str) -> bool:
        try:
            share, _, what = (folder / "blocked").read_text().partition(" ")
        except FileNotFoundError:
            return False
        return bool(what) and what in key and random.random() < float(share)

    def put_and_keep(self: Publisher, record: Any, **named: Any) -> Any:
        publisher = self._publisher
        self._publisher = nowhere if lost(self.key) else publisher  # pyright: ignore
        try:
            header = put(self, record, **named)
        finally:
            self._publisher = publisher
        if self.key.endswith(JOINTS[node]) and (part := self.key.split("/")[-3]) in parts:
            at_s = (header.stamp_wall_ns - self._clock.offset_ns) / 1e9
            joints = _record(self.key, record)
            row = [[at_s], joints.position_rad, joints.velocity_rad_s]
            os.write(file_of(part), np.concatenate(row).tobytes())
        return header

    Publisher.publish = put_and_keep


_node = sys.orig_argv[4] if sys.orig_argv[1:4] == ["-m", "vla_zenoh", "node"] else ""
_folder = os.environ.get("FLIGHT_FOLDER")
_parts = os.environ.get("FLIGHT_PARTS")
if _folder and _parts and _node in JOINTS:
    _install_parts(_node, Path(_folder), _parts.split(","))
elif _folder and _node in RECORDED:
    _install(_node, os.path.join(_folder, f"{_node}.flight"))
