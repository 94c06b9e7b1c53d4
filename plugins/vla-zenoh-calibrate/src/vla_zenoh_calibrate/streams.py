"""Views from a recording, or from the bus while a person or a tour moves the arm."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, bytes_of, header_of
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.codec.image import MAX_IMAGE_BYTES, decode_jpeg, decode_raw
from vla_zenoh.errors import CodecError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.evaluation.evaluate import recordings
from vla_zenoh.lab.recording.reader import Recording
from vla_zenoh.lab.recording.sample import JPEG, RAW
from vla_zenoh.types import Image, NodeStatus
from vla_zenoh_calibrate.arm import Arm
from vla_zenoh_calibrate.board import Refused
from vla_zenoh_calibrate.errors import CalibrationError
from vla_zenoh_calibrate.sampling import Sampler, Taken

STATES_KEPT = 4096
PAUSE_S, SILENT_S = 0.02, 5.0


def lens_of_status(status: NodeStatus | None, camera: str) -> Mapping[str, float]:
    """What a camera node says of a camera's lens; empty: nothing."""
    cameras = {} if status is None else status.detail.get("cameras")
    about: Any = cameras.get(camera) if isinstance(cameras, Mapping) else None
    found = about.get("intrinsics") if isinstance(about, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def read_recording(
    file: Recording, sampler: Sampler, camera: str, arm: Arm | None, tell: Callable[[str], None]
) -> Mapping[str, float]:
    """Show a recording to a sampler; returns what its camera node said of the lens.

    Raises:
        CalibrationError: it has no images of the camera, or clocks differ.
    """
    keys, lens = file.keys, dict[str, float]()
    images = {keys.camera_raw(camera), keys.camera_jpeg(camera)}
    shown: set[str] = set()
    wanted = images | ({arm.key} if arm is not None else set())
    for sample in file.entries(lambda key: key in wanted or key.startswith(_statuses(keys))):
        if sample.header is None:
            continue
        stamp_ns, received_ns = sample.stamp_ns, sample.received_ns
        if sample.key in images:
            # Pixels are better than the JPEG of the same image.
            if sample.key == keys.camera_jpeg(camera) and keys.camera_raw(camera) in shown:
                continue
            shown.add(sample.key)
            sampler.add_image(stamp_ns, _decoded(sample.payload, sample.encoding).rgb, received_ns)
        elif sample.kind is NodeStatus:
            lens = dict(lens_of_status(sample.record(), camera)) or lens
        elif arm is not None and sample.kind is arm.kind:
            sampler.add_state(stamp_ns, arm.pose(sample.record()), received_ns)
        _tell(sampler.settle(), sampler, tell)
    _tell(sampler.settle(at_end=True), sampler, tell)
    if not shown:
        raise CalibrationError(f"{file.path} has no images of camera {camera!r}")
    return lens


def _statuses(keys: Keys) -> str:
    return keys.all_status.rstrip("*")


def _decoded(payload: bytes, encoding: str) -> Image:
    if encoding == JPEG:
        return decode_jpeg(payload)
    if encoding.startswith(RAW):
        return decode_raw(payload, encoding.partition(";")[2])
    raise CalibrationError(f"images are of an encoding {encoding!r}; wanted are pixels or JPEG")


def _tell(
    outcomes: Iterable[Taken | Refused], sampler: Sampler, tell: Callable[[str], None]
) -> None:
    for one in outcomes:
        if isinstance(one, Taken):
            corners = one.view.corners
            tell(
                f"view {len(sampler.taken)}: {len(corners.ids)} of "
                f"{len(sampler.board.points_m)} corners, edges {corners.edge_px:.1f} px wide"
            )


class Live:
    """Images and states of a robot on the bus.

    Args:
        client: of the robot.
        sampler: that they are shown to.
        camera: name of the camera.
        arm: whose states; None: no arm has to do with it.
        jpeg: take the JPEG stream, which crosses a network more easily.
        tell: gets a sentence about each view.
    """

    def __init__(
        self,
        client: Client,
        sampler: Sampler,
        camera: str,
        arm: Arm | None,
        tell: Callable[[str], None],
        *,
        jpeg: bool = False,
    ) -> None:
        self._sampler, self._arm, self._tell, self._camera = sampler, arm, tell, camera
        self._client = client
        self._images, self._states = LatestSample(MAX_IMAGE_BYTES), CallbackRing(STATES_KEPT)
        keys = client.keys
        self._image_key = keys.camera_jpeg(camera) if jpeg else keys.camera_raw(camera)
        client.watch(self._image_key, self._images)
        if arm is not None:
            client.watch(arm.key, self._states)
        self._silent_since_s = self._left_s = time.monotonic()
        self._last_why = ""

    @property
    def lens(self) -> Mapping[str, float]:
        """What the camera's node says of its lens; empty: nothing."""
        found = [status for status, _, _ in self._client.snapshot().values()]
        each = [lens_of_status(status, self._camera) for status in found]
        return next((one for one in each if one), {})

    def pump(self, seconds: float, *, images: bool = True) -> list[Taken | Refused]:
        """Take what comes in a time; returns what became of its images.

        Args:
            images: else only states are taken.

        Raises:
            CalibrationError: nothing comes, or clocks differ.
        """
        began_s = time.monotonic()
        until_s = began_s + seconds
        # What waited for a move of the arm, or for a person, has not listened.
        self._silent_since_s += began_s - self._left_s
        out: list[Taken | Refused] = []
        while time.monotonic() < until_s:
            self._take_states()
            sample = self._images.pop()
            if sample is not None:
                self._silent_since_s = time.monotonic()
                if images:
                    payload = bytes_of(sample.sample.payload, MAX_IMAGE_BYTES)
                    image = _decoded(payload, str(sample.sample.encoding))
                    stamp_ns = header_of(sample.sample).stamp_wall_ns
                    self._sampler.add_image(stamp_ns, image.rgb, sample.mono_ns)
            elif time.monotonic() - self._silent_since_s > SILENT_S:
                raise CalibrationError(
                    f"no image on {self._image_key} for {SILENT_S:g} s; `vla-zenoh status` shows "
                    "the camera's node"
                )
            found = self._sampler.settle()
            _tell(found, self._sampler, self._tell)
            self._tell_why(found)
            out += found
            time.sleep(PAUSE_S)
        self._left_s = time.monotonic()
        return out

    def _take_states(self) -> None:
        if self._arm is None:
            return
        for sample in self._states.drain():
            try:
                state = records.decode(self._arm.kind, bytes_of(sample.sample.payload))
                header = header_of(sample.sample)
            except CodecError:
                continue  # the nodes count and report it
            self._sampler.add_state(header.stamp_wall_ns, self._arm.pose(state), sample.mono_ns)

    def _tell_why(self, outcomes: Iterable[Taken | Refused]) -> None:
        """A reason once, until another one comes."""
        for one in outcomes:
            if isinstance(one, Taken):
                self._last_why = ""
            elif one.reason not in ("waiting", self._last_why):
                self._last_why = one.reason
                self._tell(f"not taken: {one.why}")


def recordings_of(path: Path) -> list[Path]:
    """The recordings that a path names: a file, or those in a run folder.

    Raises:
        CalibrationError: there is none.
    """
    found = list(recordings([path]))
    if not found:
        raise CalibrationError(f"{path} holds no recording (.mcap)")
    return found
