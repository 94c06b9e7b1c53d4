"""Following a robot: its chunks and commands become journeys."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, bytes_of, header_of
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, JointCommand, PoseCommand, Stamped
from vla_zenoh_otel.journeys import Journey, Journeys

PERIOD_S = 0.05
CHUNKS, COMMANDS = 256, 1024


def follow(
    profile: Profile,
    session: zenoh.Session,
    send: Callable[[Journey], None],
    stop: threading.Event,
) -> int:
    """Hand over every journey of the robot until `stop`, without those that then still wait.

    Returns how many chunks were given up.
    """
    journeys, keys = Journeys(profile.robot.name), profile.keys
    kind = JointCommand if profile.robot.command == "joint" else PoseCommand
    chunks, commands = CallbackRing(CHUNKS), CallbackRing(COMMANDS)
    command_keys = (keys.of_part(part) for part in profile.part_names)
    subscribers = [
        chunks.subscribe(session, keys.all_deltas),
        *(
            commands.subscribe(
                session, each.command_joint if kind is JointCommand else each.command_pose
            )
            for each in command_keys
        ),
    ]
    while not stop.wait(PERIOD_S):
        found = [
            *(
                journeys.take_chunk(chunk)
                for chunk in filter(None, (_read(ActionChunk, one) for one in chunks.drain()))
            ),
            *(
                journeys.take_command(command.record.cause, command.header.stamp_wall_ns)
                for command in filter(None, (_read(kind, one) for one in commands.drain()))
            ),
            *journeys.overdue(time.monotonic_ns()),
        ]
        for journey in filter(None, found):
            send(journey)
    for subscriber in subscribers:
        subscriber.undeclare()
    return journeys.lost


def _read(kind: type[Any], arrival: ReceivedSample) -> Stamped[Any] | None:
    """A record with its header; None: it cannot be decoded, which the nodes count and report."""
    try:
        header = header_of(arrival.sample)
        record = records.decode(kind, bytes_of(arrival.sample.payload))
        return Stamped(header, record, arrival.mono_ns)
    except CodecError:
        return None
