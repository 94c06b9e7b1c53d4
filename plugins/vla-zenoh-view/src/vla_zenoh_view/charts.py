"""Time series: latencies, speeds, gripper, tracking, speed override, joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from vla_zenoh.types import ActionChunk, Cause, FloatArray, NodeStatus
from vla_zenoh_view import paths

STAGE_COLOURS = {
    "capture_to_worker": (94, 166, 255),
    "inference": (236, 92, 206),
    "worker_to_command": (255, 176, 58),
    "command_to_pose": (240, 220, 110),
    "end_to_end": (150, 158, 172),
}


class Charts:
    """Logs time series at the current time of a Rerun stream.

    Args:
        joints: names of the arm joints, in the order of the profile.
        part: of the robot; empty: it is one arm.
    """

    def __init__(self, stream: rr.RecordingStream, joints: Sequence[str], part: str = "") -> None:
        self._stream, self._joints, self._part = stream, tuple(joints), part
        self._newest: tuple[str, int] | None = None
        for stage, colour in STAGE_COLOURS.items():
            self._style(paths.below(paths.LATENCY, stage), stage, colour)
        for origin in (paths.SPEED, paths.GRIPPER):
            for name in (paths.COMMANDED, paths.MEASURED):
                # A gripper command holds until the next one.
                held = origin == paths.GRIPPER and name == paths.COMMANDED
                series = f"{part} {name}".strip()
                self._style(f"{self._own(origin)}/{name}", series, paths.COLOURS[name], held=held)
        self._style(
            f"{self._own(paths.TRACKING)}/distance",
            f"{part} distance".strip(),
            STAGE_COLOURS["end_to_end"],
        )
        self._style(f"{paths.BOUNDS}/share", "share", paths.COLOURS[paths.COMMANDED])

    def _own(self, origin: str) -> str:
        return paths.plot(origin, self._part)

    def _style(
        self, path: str, name: str, colour: tuple[int, int, int], *, held: bool = False
    ) -> None:
        between = "StepAfter" if held else "Linear"
        lines = rr.SeriesLines(
            colors=[colour], names=[name], widths=[1.5], interpolation_mode=between
        )
        self._stream.log(path, lines, static=True)

    def _put(self, path: str, value: float) -> None:
        self._stream.log(path, rr.Scalars([value]))

    # -- latency ------------------------------------------------------------------------------
    def command(self, stamp_ns: int, cause: Cause | None) -> None:
        """Latencies of a chunk, at its first command."""
        if cause is None or (cause.worker, cause.chunk_seq) == self._newest:
            return
        self._newest = (cause.worker, cause.chunk_seq)
        for stage, duration_ms in cause.latency_ms(stamp_ns).items():
            self._put(paths.below(paths.LATENCY, stage), duration_ms)

    def shadow(self, chunk: ActionChunk) -> None:
        """Inference time of a worker in the shadow."""
        took_ns = chunk.inference_end_ns - chunk.inference_start_ns
        self._put(paths.below(paths.LATENCY, f"inference of {chunk.worker}"), took_ns / 1e6)

    # -- motion -------------------------------------------------------------------------------
    def speed(self, name: str, twist: FloatArray) -> None:
        """Speed of the TCP: `commanded` or `measured`."""
        self._put(f"{self._own(paths.SPEED)}/{name}", float(np.linalg.norm(twist[:3])) * 1e3)

    def tracking(self, apart_m: float) -> None:
        """Distance between the measured and the commanded TCP."""
        self._put(f"{self._own(paths.TRACKING)}/distance", apart_m * 1e3)

    def joints(self, names: Sequence[str], position_rad: FloatArray) -> None:
        for name, value in zip(names, position_rad.tolist(), strict=True):
            if name in self._joints:
                self._put(paths.below(self._own(paths.JOINTS), name), value)

    def gripper(self, name: str, width_m: float) -> None:
        """Opening of the gripper: `commanded` or `measured`."""
        self._put(f"{self._own(paths.GRIPPER)}/{name}", width_m * 1e3)

    def status(self, status: NodeStatus) -> None:
        """Share of the speed that limits leave, as the command node reports it."""
        share = status.detail.get("speed_share")
        if isinstance(share, (int, float)):
            self._put(f"{paths.BOUNDS}/share", share * 100.0)
