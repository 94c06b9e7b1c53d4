"""The ring of a rolling record: bounded in time and room; what is saved stays."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dataset_rig import KEYS, ZERO_NS, put
from vla_zenoh_rolling.ring import FACTS, PART, Ring, RingLimits, delete_oldest_saved

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.evaluation.evaluate import recordings
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.types import Task

SEGMENT_S = 30.0


def ring(folder: Path, *, keep_s: float = 100.0, max_bytes: int = 10_000) -> Ring:
    return Ring(folder, RingLimits(keep_s, max_bytes, SEGMENT_S))


def filled(folder: Path, sizes: list[int], *, seconds: float = SEGMENT_S, **bounds: float) -> Ring:
    out = ring(folder, **bounds)  # pyright: ignore[reportArgumentType]
    for size in sizes:
        path = out.next_path()
        path.write_bytes(b"x" * size)
        out.add(path, seconds)
    return out


def test_the_ring_keeps_no_less_than_it_is_to_and_at_most_a_segment_more(tmp_path: Path) -> None:
    kept = filled(tmp_path, [10] * 50)
    assert 100.0 <= kept.seconds < 100.0 + SEGMENT_S
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"segment-{number:08d}.mcap" for number in (47, 48, 49, 50)
    ]


def test_the_ring_takes_no_more_room_than_it_may(tmp_path: Path) -> None:
    kept = filled(tmp_path, [4_000] * 9)
    assert kept.size_bytes == sum(path.stat().st_size for path in tmp_path.iterdir()) == 8_000
    assert kept.seconds == 2 * SEGMENT_S


def test_a_ring_goes_on_with_what_a_process_before_left(tmp_path: Path) -> None:
    filled(tmp_path, [10] * 3)
    after = ring(tmp_path)
    assert len(after.segments) == 3
    assert after.next_path().name == "segment-00000004.mcap"


def test_what_is_saved_outlives_the_ring_and_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    kept = filled(tmp_path / "ring", [10] * 3)
    log = tmp_path / "log.jsonl"
    log.write_text("a line\n")
    folder = tmp_path / "saved" / "stop"
    assert kept.save(folder, [log], {"asked": False}) == 3
    while kept.segments:
        kept.drop_oldest()
    assert [path.name for path in sorted(folder.iterdir())][1:] == [
        FACTS,
        *(f"segment-{number:08d}.mcap" for number in (1, 2, 3)),
    ]
    assert not list((tmp_path / "saved").glob(f"*{PART}"))
    with pytest.raises(RecordingError, match="cannot be written"):
        filled(tmp_path / "more", [10]).save(folder, [], {})


def test_only_what_nobody_asked_for_is_deleted(tmp_path: Path) -> None:
    for number in range(6):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        (folder / FACTS).write_text(json.dumps({"asked": number in (0, 3)}))
    (tmp_path / "mine").mkdir()
    assert [path.name for path in delete_oldest_saved(tmp_path, 2)] == ["1", "2"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "3", "4", "5", "mine"]


def test_a_folder_of_segments_is_read_as_one_recording(tmp_path: Path) -> None:
    folder = tmp_path / "saved" / "stop"
    made = ring(folder)
    for number in range(3):
        out = RecordingWriter(
            made.next_path(), KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS
        )
        task = Task(number, False, f"prompt {number}", "teacher", 5.0)
        out.write(put(KEYS.task, task, number, number))
        if number == 1:
            out.commit()
            out.abandon()  # its process was killed
        else:
            out.finish({"dropped": {"key": 2}})
    run = load_run(folder)
    assert [entry.record.prompt for entry in run.tasks] == ["prompt 0", "prompt 1", "prompt 2"]
    assert run.file.dropped == 4
    assert list(recordings([tmp_path])) == [folder]
    assert open_recording(folder).keys == KEYS
