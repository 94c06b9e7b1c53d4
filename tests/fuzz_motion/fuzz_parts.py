"""Random chunks for two arms under one policy: the least distance between them, tick by tick.

    python tests/fuzz_motion/fuzz_parts.py --ticks 100000 --seed 1

The arms are perfect: each stands where it was commanded last. Every run of `RUN_TICKS` has a seed
of its own, in joints or in poses, from home. Exits with 1 where the arms came nearer than
``part_stop_m`` by more than `TOLERANCE_M`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from pair_rig import (
    DT_S,
    HORIZON,
    PARTS,
    TICK_S,
    apart_m,
    joint_steps,
    random_motion,
    reach,
    shipped,
    tcp_steps,
)

from vla_zenoh.control.commander import Commander, Inputs, Setting
from vla_zenoh.control.commander_io import NewStates
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.types import (
    ActionChunk,
    FloatArray,
    GripperState,
    Header,
    JointState,
    PoseState,
    Stamped,
)

RUN_TICKS = 5000
CHUNK_TICKS, STATE_TICKS = 50, 4
TOLERANCE_M = 1e-3
START_NS = 1_700_000_000_000_000_000
SOURCE = "worker-scripted_pair#1"


class PerfectPair:
    """A commander of two arms that stand where they were commanded last."""

    def __init__(self, kind: str, seed: int) -> None:
        action = tcp_steps() if kind == "tcp" else joint_steps("absolute")
        self._motion = random_motion(seed, kind)
        spec = ModelSpec(
            name="random",
            observation=ObservationSpec(state=("pose",), prompt=False),
            action=ActionSpec.of_parts(dict.fromkeys(PARTS, action)),
        )
        self.spec, self.now_ns, self._ticks, self._chunks = spec, START_NS, 0, 0
        self.commander = Commander(shipped(), reach=reach())
        home_rad = np.array(shipped().robot.home_rad)
        self.joints_rad: dict[str, np.ndarray] = dict.fromkeys(PARTS, home_rad)
        self._peers = PeerSnapshot(
            alive=frozenset({"sim", "worker-scripted_pair"}),
            specs={"scripted_pair": spec},
            spec_sources={"scripted_pair": SOURCE},
            same_host=frozenset({"sim", "worker-scripted_pair"}),
        )

    def tick(self) -> FloatArray:
        """One period; the joints of both arms, (2, n)."""
        self.now_ns += round(TICK_S * 1e9)
        inputs = Inputs(peers=self._peers)
        if self._ticks % STATE_TICKS == 0:
            inputs.parts = {part: self._states(part) for part in PARTS}
        if self._ticks % CHUNK_TICKS == 0:
            inputs.chunks = [self._chunk()]
        if self.commander.state.value == "inactive" and self._ticks % 100 == 50:
            inputs.settings = [Setting("active", True)]
        out = self.commander.step(inputs, self.now_ns)
        for part, commands in out.parts.items():
            if commands.joint is not None:
                self.joints_rad[part] = np.array(commands.joint.position_rad)
        self._ticks += 1
        return np.array([self.joints_rad[part] for part in PARTS])

    def _states(self, part: str) -> NewStates:
        header = Header(self.now_ns, self._ticks, "sim#1")
        arm, joints_rad = reach()[part].kinematics, self.joints_rad[part]
        pose = arm.forward(joints_rad)
        still = np.zeros(len(joints_rad))
        told = PoseState(pose.position_m, quat_from_rotation(pose.rotation), np.zeros(6))
        joints = JointState(arm.arm_joints, joints_rad, still, None)
        return NewStates(
            Stamped(header, told, self.now_ns),
            Stamped(header, GripperState(0.04, False, False), self.now_ns),
            Stamped(header, joints, self.now_ns),
        )

    def _chunk(self) -> Stamped[ActionChunk]:
        self._chunks += 1
        step = np.concatenate([self._motion(self._chunks)[part] for part in PARTS])
        record = ActionChunk(
            worker="scripted_pair",
            spec_hash=self.spec.hash,
            episode=self.commander.task.episode,
            observation_stamp_ns=self.now_ns,
            observation_seq=self._chunks,
            valid_until_ns=self.now_ns + round(HORIZON * DT_S * 1e9),
            steps=np.tile(step, (HORIZON, 1)).astype(np.float32),
            observed_ns=self.now_ns,
            inference_start_ns=self.now_ns,
            inference_end_ns=self.now_ns,
        )
        return Stamped(Header(self.now_ns, self._chunks, SOURCE), record, self.now_ns)


def least_m(kind: str, seed: int, ticks: int) -> tuple[float, int]:
    """The least distance in a run, and how many of its ticks the arms were held."""
    pair, least, held = PerfectPair(kind, seed), np.inf, 0
    for _ in range(ticks):
        at = pair.tick()
        least = min(least, apart_m(*at))
        held += pair.commander.parts[0].motion.must_pause
    return float(least), held


def main() -> int:
    """Run, and tell the least distance of all runs."""
    read = argparse.ArgumentParser(description=__doc__)
    read.add_argument("--ticks", type=int, default=100_000)
    read.add_argument("--seed", type=int, default=1)
    given = read.parse_args()
    stop_m, worst, done, seed, held = shipped().limits.reach.part_stop_m, np.inf, 0, given.seed, 0
    began_s = time.monotonic()
    while done < given.ticks:
        kind = ("tcp", "joint")[seed % 2]
        found, stood = least_m(kind, seed, RUN_TICKS)
        done, held, worst = done + RUN_TICKS, held + stood, min(worst, found)
        if found < stop_m - TOLERANCE_M:
            print(f"too near: {kind}, seed {seed}: {found * 1e3:.3f} mm")
        seed += 1
        if (seed - given.seed) % 10 == 0:
            _tell(done, worst, held, time.monotonic() - began_s)
    _tell(done, worst, held, time.monotonic() - began_s)
    return int(worst < stop_m - TOLERANCE_M)


def _tell(ticks: int, worst_m: float, held: int, took_s: float) -> None:
    each = f"{took_s / ticks * 1e3:.2f} ms each"
    print(f"{ticks} ticks, least {worst_m * 1e3:.3f} mm, held in {held}, {each}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
