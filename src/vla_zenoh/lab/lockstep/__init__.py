"""The whole loop in one thread on a virtual clock: robot, cameras, worker, command node.

The same `Commander`, `ArmGuard` and `assemble` as in the nodes, and every record goes through
the codec as on the wire; only sessions, threads and waiting are left out. A run is reproducible to
the bit and as fast as the computer: for tests, for making data, for measuring what latency does.

Faults are put in from outside: `Lockstep.tamper` stands on the wire and may drop, delay, repeat or
change every message; `Lockstep.set_clock` sets the wall clock of one node; `Lockstep.alive` names
the nodes that others believe alive.
"""

from __future__ import annotations

from vla_zenoh.lab.lockstep.loop import CAMERA, COMMAND, SIM, START_NS, TICK_NS, Lockstep
from vla_zenoh.lab.lockstep.records import Delays, LockstepTrace, Message, Tamper

__all__ = [
    "CAMERA",
    "COMMAND",
    "SIM",
    "START_NS",
    "TICK_NS",
    "Delays",
    "Lockstep",
    "LockstepTrace",
    "Message",
    "Tamper",
]
