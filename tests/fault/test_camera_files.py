"""Files and devices that are not there, go, come back, or are broken."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_rig import camera_rig, grey, until, write_video

from vla_zenoh.profile.schema import CameraProfile

pytestmark = pytest.mark.long

SETTLE_S = 0.3
RETURN_S = 3.0  # the longest pause between two attempts, and a status


def camera(path: Path, **more: object) -> CameraProfile:
    fields = {"source": f"file:{path}", "width": 64, "height": 48, "rate_hz": 30, **more}
    return CameraProfile.model_validate(fields)


def test_a_video_that_vanishes_is_lost_and_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    write_video(path, [grey(100)] * 20, rate_hz=20)
    with camera_rig({"front": camera(path)}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        rig.wait_for("front", "ok")
        path.rename(tmp_path / "away.avi")
        told = rig.wait_for("front", "lost")
        assert str(path) in told["why"]
        (lost,) = rig.happened("front:ok->lost")
        assert lost.level == "warning"
        assert "has vanished" in lost.why
        assert rig.counter("front.losses") == 1
        assert rig.statuses[-1].state == "degraded"
        time.sleep(SETTLE_S)
        frames.clear()
        time.sleep(SETTLE_S)
        assert frames == []
        assert rig.camera("front")["age_s"] > SETTLE_S

        write_video(path, [grey(200)] * 20, rate_hz=20)
        until("pictures of the new file", lambda: frames, RETURN_S)
        assert (frames[-1].rgb == 200).all()
        rig.wait_for("front", "ok")
        assert rig.happened("front:lost->ok")


def test_a_folder_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    with camera_rig({"front": camera(folder)}) as rig:
        until("a reason", lambda: str(folder) in rig.camera("front").get("why", ""))
        assert rig.camera("front")["state"] == "waiting"
        assert rig.camera("front")["age_s"] is None
        folder.mkdir()
        until("another reason", lambda: "no image in the folder" in rig.camera("front")["why"])
        (folder / "late.png").write_bytes(cv2.imencode(".png", grey(50))[1].tobytes())
        rig.wait_for("front", "ok")
        assert rig.happened("front:waiting->ok")
        assert rig.counter("front.losses") == 0


def test_a_broken_picture_is_left_out_and_counted(tmp_path: Path) -> None:
    for i in range(4):
        good = cv2.imencode(".png", np.full((48, 64, 3), 50 * i, np.uint8))[1].tobytes()
        (tmp_path / f"{i}.png").write_bytes(good if i != 2 else good[:40])
    with camera_rig({"front": camera(tmp_path)}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("three rounds", lambda: len(frames) > 9)
        assert {int(frame.rgb[0, 0, 0]) for frame in frames} == {0, 50, 150}
        until("a count", lambda: rig.counter("front.broken") > 0)
        assert rig.happened("front:broken_picture")
        assert rig.camera("front")["state"] == "ok"


def test_nothing_but_broken_pictures_is_no_camera(tmp_path: Path) -> None:
    good = cv2.imencode(".png", grey(50))[1].tobytes()
    (tmp_path / "0.png").write_bytes(good[:40])
    with camera_rig({"front": camera(tmp_path)}) as rig:
        told = until(
            "the reason",
            lambda: (
                rig.camera("front") if "could not be decoded" in rig.camera("front")["why"] else 0
            ),
        )
        assert told["state"] == "waiting"
        assert told["age_s"] is None


def test_one_dead_camera_does_not_disturb_the_others(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), grey(50))
    dead = CameraProfile(source="v4l2:/dev/video97")
    with camera_rig({"front": camera(tmp_path), "wrist": dead}) as rig:
        frames, _ = rig.listen(rig.profile.keys.camera_raw("front"))
        until("a reason", lambda: "/dev/video97" in rig.camera("wrist").get("why", ""))
        assert "--device=/dev/video97" in rig.camera("wrist")["why"]
        rig.wait_for("front", "ok")
        until("pictures", lambda: len(frames) > 20)
        assert rig.camera("wrist")["state"] == "waiting"
        assert rig.statuses[-1].state == "degraded"


def test_a_listener_that_leaves_without_a_word_does_not_stop_the_pictures(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), grey(50))
    with camera_rig({"front": camera(tmp_path)}) as rig:
        key = rig.profile.keys.camera_raw("front")
        frames, first = rig.listen(key)
        others = [rig.listen(key)[1] for _ in range(3)]
        until("pictures", lambda: len(frames) > 5)
        for other in others:
            other.undeclare()
        count = len(frames)
        until("more pictures", lambda: len(frames) > count + 10)
        first.undeclare()
