"""When a worker has the images for an inference: one of every camera, none of them shown before."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from camera_rig import routed_session, until

from vla_zenoh.bus.buffers import Wake
from vla_zenoh.codec import records
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy import ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Header, Task

pytestmark = pytest.mark.long

CAMERAS = ("front", "wrist")
STEP_S = 0.5
BLANK = np.zeros((480, 640, 3), np.uint8)


class Look:
    """A model of two cameras."""

    spec = ModelSpec(
        name="look",
        observation=ObservationSpec(
            cameras=tuple(CameraSpec(camera=name) for name in CAMERAS), state=()
        ),
        action=ActionSpec(horizon=2, dt_s=STEP_S, rotation="rpy", gripper="none"),
    )

    def infer(self, _: object) -> ActionSteps:
        return ActionSteps(np.zeros((2, 6)))


class Cameras:
    """The cameras and the command node of one worker, which is told of images by `changed`."""

    def __init__(self, session: zenoh.Session) -> None:
        profile = load_profile("panda_sim")
        self.changed = Wake()
        self.worker = RobotSession(
            profile, session, Look(), "look", images="raw", host=None, changed=self.changed
        )
        self._keys, self._session, self._seq = profile.keys, session, 0
        self.set_speed(100.0)

    def set_speed(self, percent: float) -> None:
        task = Task(1, True, "look", "look", 10.0, percent)
        self._put(self._keys.task, records.encode(task), "command#1")

    def show(self, camera: str) -> None:
        self._put(self._keys.camera_raw(camera), BLANK.tobytes(), "camera#1")

    def _put(self, key: str, payload: bytes, source: str) -> None:
        self._seq += 1
        header = records.encode_header(Header(time.time_ns(), self._seq, source))
        encoding = "zenoh/bytes;rgb8;480x640" if source.startswith("camera") else None
        self._session.put(key, payload, attachment=header, encoding=encoding)


@pytest.fixture
def cameras() -> Iterator[Cameras]:
    with routed_session() as session:
        found = Cameras(session)
        yield found
        found.worker.close()


def answer(worker: RobotSession) -> None:
    """Observe, and publish a chunk."""
    observation = until("an observation", worker.observe)
    now_ns = time.time_ns()
    worker.publish(observation, Look().infer(observation), (now_ns,) * 3, 1)
    assert not worker.complaint


def has_new(worker: RobotSession, camera: str) -> bool:
    (stream,) = (each for each in worker._cameras if each.camera == camera)
    return stream.has_new


def test_a_worker_is_woken_when_every_camera_has_sent_an_image_and_not_by_the_first(
    cameras: Cameras,
) -> None:
    worker = cameras.worker
    cameras.show("front")
    until("the first image", lambda: has_new(worker, "front"))
    assert not worker.has_images
    cameras.show("wrist")
    until("both images", lambda: worker.has_images)
    worker.poll()
    assert not worker.has_images


def test_after_a_chunk_every_camera_has_to_send_a_new_image(cameras: Cameras) -> None:
    worker = cameras.worker
    for _ in range(2):
        for camera in CAMERAS:
            cameras.show(camera)
        until("both images", lambda: worker.has_images)
        answer(worker)
        cameras.show("wrist")
        until("a new image", lambda: has_new(worker, "wrist"))
        assert not worker.has_images


def test_an_image_that_was_looked_at_but_not_used_waits_for_the_others(cameras: Cameras) -> None:
    worker = cameras.worker
    cameras.show("front")
    until("the first image", lambda: has_new(worker, "front"))
    assert worker.observe() is None
    assert not worker.has_images
    cameras.show("wrist")
    until("both images", lambda: worker.has_images)
    seen = worker.observe()
    assert seen is not None, worker.complaint


def test_a_speed_override_of_which_only_its_end_is_left_between_two_looks_still_counts(
    cameras: Cameras,
) -> None:
    worker = cameras.worker
    for camera in CAMERAS:
        cameras.show(camera)
    until("both images", lambda: worker.has_images)
    answer(worker)
    cameras.set_speed(0.0)
    time.sleep(1.1 * STEP_S)
    cameras.set_speed(100.0)
    for camera in CAMERAS:
        cameras.show(camera)
    until("both images", lambda: worker.has_images)
    observation = until("an observation", worker.observe)
    committed = worker.prefix.committed(observation)
    assert committed is not None, "the arm stood, so its first step is not over"
