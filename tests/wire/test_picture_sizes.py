"""Pictures in a model's own size: for the ninth model too, and plain ones where there are none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import pytest
import zenoh
from camera_rig import Rig, camera_rig, free_endpoint, grey, until

from vla_zenoh.bus.buffers import Wake
from vla_zenoh.bus.node import Node, Publisher
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.camera import node as camera_node
from vla_zenoh.nodes.camera.camera_publisher import MAX_SIZES
from vla_zenoh.nodes.worker.robot_session import CameraStream, colour_keys
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.policy.observation import History, size_variant
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.types import Image

pytestmark = pytest.mark.long

SILENCE_S = 1.0
"""Of models, in these tests."""
PLAIN_SEQ = 1000
"""Number of the first plain picture."""
TURN_S = 0.15
"""Long enough for a spec to be heard; where it is not the thief changes his mind less often."""


def sized(width: int) -> CameraSpec:
    return CameraSpec(camera="front", width=width, height=width, resize="pad")


def spec(width: int) -> ModelSpec:
    return ModelSpec(
        name="any",
        observation=ObservationSpec(cameras=(sized(width),)),
        action=ActionSpec(horizon=1, dt_s=0.2, frame="tcp", rotation="rpy", gripper="none"),
    )


class Models:
    """Workers that say their specs again and again until they leave."""

    def __init__(self, rig: Rig) -> None:
        node = Node("worker-test", rig.profile, rig.watcher)
        self._node, self._widths = node, dict[str, int]()
        self._outs: dict[str, Publisher] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def come(self, worker: str, width: int) -> None:
        out = self._outs.get(worker) or self._node.declare_publisher(
            self._node.keys.spec(worker), Kind.TELEMETRY
        )
        until("the camera node", lambda: out.has_subscribers)
        self._outs[worker] = out
        self._widths[worker] = width

    def leave(self, worker: str) -> None:
        del self._widths[worker]

    def _run(self) -> None:
        while not self._stop.wait(TURN_S / 3):
            for worker, width in list(self._widths.items()):
                self._outs[worker].publish(spec(width))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._node.close()


@contextmanager
def stage(folder: Path) -> Iterator[tuple[Rig, Models, Callable[[int], list[Any]]]]:
    """A camera node that fits pictures, models, and who listens to one size."""
    assert cv2.imwrite(str(folder / "grey.png"), grey(99))
    camera = CameraProfile(
        source=f"file:{folder}", width=64, height=48, rate_hz=20, fit_for_workers=True
    )
    with camera_rig({"front": camera}) as rig:
        models, kept = Models(rig), []

        def listen(width: int) -> list[Any]:
            form = size_variant(sized(width))
            assert form is not None
            frames, subscriber = rig.listen(rig.profile.keys.camera_fitted("front", form))
            kept.append(subscriber)
            return frames

        try:
            yield rig, models, listen
        finally:
            models.close()


def test_the_ninth_size_is_told_and_made_as_soon_as_another_one_is_not_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_node, "SILENCE_S", SILENCE_S)
    with stage(tmp_path) as (rig, models, listen):
        heard = [listen(16 + 2 * number) for number in range(MAX_SIZES)]
        for number in range(MAX_SIZES):
            models.come(f"w{number}", 16 + 2 * number)
        until("all of them", lambda: all(heard))
        ninth = listen(100)
        models.come("w8", 100)
        (event,) = until("it is told", lambda: rig.happened("front:too_many_sizes"))
        assert "100x100-pad" in event.why
        assert not ninth
        models.leave("w0")  # and its listener stays
        until("the ninth", lambda: ninth)
        assert decode_jpeg(ninth[-1].payload).rgb.shape == (100, 100, 3)
        (event,) = until("it is told", lambda: rig.happened("front:size_given_back"))
        assert "16x16-pad" in event.why


@pytest.mark.slow
def test_who_changes_his_mind_takes_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_node, "SILENCE_S", SILENCE_S)
    monkeypatch.setattr(camera_node, "SIZES_PERIOD_S", TURN_S / 4)
    with stage(tmp_path) as (rig, models, listen):
        for number in range(MAX_SIZES + 4):
            models.come("thief", 16 + 2 * number)
            time.sleep(TURN_S)
        honest = listen(200)
        models.come("honest", 200)
        until("pictures for who asks honestly", lambda: honest)
        assert not rig.happened("front:too_many_sizes")
        assert rig.happened("front:size_given_back")


@contextmanager
def two_nodes() -> Iterator[tuple[Node, Node]]:
    """A camera node's and a worker's, each with a session of its own."""
    endpoint = free_endpoint()
    profile = override(
        load_profile("panda_sim_two_hosts"),
        {
            "session": {"listen": [endpoint], "connect": [endpoint]},
            "cameras": {"front": {"source": "sim:front", "fit_for_workers": True}},
        },
    )
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as there,
        open_session(profile.session) as here,
    ):
        camera, worker = Node("camera", profile, there), Node("worker-far", profile, here)
        yield camera, worker
        camera.close()
        worker.close()


def test_plain_pictures_are_taken_while_none_come_in_the_own_size_and_no_longer() -> None:
    jpeg = encode_jpeg(Image(grey(50)), 90)
    with two_nodes() as (camera, worker):
        keys = worker.keys
        own = camera.declare_publisher(keys.camera_fitted("front", "32x32-pad"), Kind.FRAME)
        plain = camera.declare_publisher(keys.camera_jpeg("front"), Kind.FRAME)
        images = History(1)
        ears = CameraStream(
            *(
                worker,
                "front",
                (own.key, plain.key),
                images,
                Image,
                lambda data, _: decode_jpeg(data),
            ),
            history_s=0.0,
            changed=Wake(),
        )

        def comes(stream: Publisher) -> bool:
            """Whether a picture that is put there is what is taken next."""
            images.entries.clear()
            stream.publish(jpeg, encoding=zenoh.Encoding.IMAGE_JPEG)
            ears.poll()
            numbers = [image.header.seq for image in images.entries]
            return bool(numbers) and (numbers[-1] >= PLAIN_SEQ) == (stream is plain)

        until("a reader", lambda: own.has_subscribers)
        assert not plain.has_subscribers
        plain.seq = PLAIN_SEQ  # its numbers are its own, and far ahead
        until("a plain one", lambda: comes(plain))
        until("the next", lambda: comes(plain))
        until("its own", lambda: comes(own))
        until("plain ones do not travel any more", lambda: comes(own) and not plain.has_subscribers)
        until("plain ones once more", lambda: comes(plain))


def test_a_worker_knows_where_its_pictures_are_and_where_those_of_all() -> None:
    with two_nodes() as (camera, worker):
        keys = worker.keys
        own, other = (
            camera.declare_publisher(keys.camera_fitted("front", size), Kind.FRAME)
            for size in ("32x32-pad", "64x64-pad")
        )
        for_all = camera.declare_publisher(keys.camera_jpeg("front"), Kind.FRAME)
        wanted = CameraSpec(camera="front", width=32, height=32, resize="pad")
        images = History(1)
        keys_of_it = colour_keys(wanted, worker, jpeg=True)
        ears = CameraStream(
            *(worker, "front", keys_of_it, images, Image, lambda data, _: decode_jpeg(data)),
            history_s=0.0,
            changed=Wake(),
        )
        until("its own", lambda: own.has_subscribers)
        assert not other.has_subscribers

        def takes_plain() -> bool:
            ears.poll()
            assert not images.entries
            return for_all.has_subscribers

        until("plain ones", takes_plain)
