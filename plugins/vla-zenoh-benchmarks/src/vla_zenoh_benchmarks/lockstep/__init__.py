"""Lockstep: robot, cameras, workers and command node in one thread on a virtual clock.

Runs the `Commander`, `ArmGuard` and `assemble` of the nodes, with every record through the codec;
only sessions, threads and waiting are left out. Runs are bit-reproducible and faster than real
time: for tests, data generation and latency studies.

Fault injection: `Lockstep.tamper` may drop, delay, repeat or change every message;
`Lockstep.set_clock` sets the wall clock of one node; `Lockstep.alive` holds the live nodes.
"""
