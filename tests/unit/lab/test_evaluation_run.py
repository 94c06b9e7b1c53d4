"""The evaluation of a recording, on runs whose figures are known beforehand."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner
from vla_zenoh_replay.replay import Restamper

from vla_zenoh.codec import records
from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.keys import Keys
from vla_zenoh.lab.evaluation.evaluate import evaluate
from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.evaluation.report import page
from vla_zenoh.lab.evaluation.result import TASKS, Evaluation, PlotTrace
from vla_zenoh.lab.evaluation.timelines import unbroken
from vla_zenoh.lab.recording.film import Film, write_film
from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.recording.sample import JPEG, MSGPACK, TEXT, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import load_profile, to_yaml
from vla_zenoh.program.main import app
from vla_zenoh.types import (
    ActionChunk,
    Cause,
    Event,
    GripperState,
    Header,
    Image,
    NodeStatus,
    PoseCommand,
    PoseState,
    SingleWriterFilter,
    Task,
)

KEYS = Keys("panda")
ZERO_NS = 1_700_000_000_000_000_000
TICK_NS, OFTEN_NS = 8_000_000, 4_000_000
CHUNK_NS = 200_000_000
STATE_NS = 10_000_000
SECONDS = 4
SPEED_M_S = 0.05
LAG_M = 0.002
JERK_M_S3 = 2.0
CAMERA_MS, INFERENCE_MS, RECEIVED_MS, HEARD_MS = 10, 30, 2, 3
POSITION_TOLERANCE_MM = 1e-3
QUAT = np.array([1.0, 0.0, 0.0, 0.0])
SPEC = ModelSpec(
    name="scripted",
    observation=ObservationSpec(
        cameras=(CameraSpec(camera="front", width=64, height=64, resize="stretch"),)
    ),
    action=ActionSpec(horizon=1, dt_s=0.2, gripper="none"),
)


def put(key: str, record: Any, at_ns: int, seq: int, source: str = "node#1") -> Sample:
    header = Header(ZERO_NS + at_ns, seq, source)
    return Sample(key, records.encode(record), MSGPACK, header, ZERO_NS + at_ns + 1_000_000)


def height_m(at_ns: int) -> float:
    """Goes up evenly for the first half, then stands."""
    return 0.2 + SPEED_M_S * min(at_ns, SECONDS * 500_000_000) / 1e9


def cause(index: int) -> Cause:
    taken_ns = ZERO_NS + index * CHUNK_NS
    observed_ns = taken_ns + CAMERA_MS * 1_000_000
    end_ns = observed_ns + INFERENCE_MS * 1_000_000
    received_ns = end_ns + RECEIVED_MS * 1_000_000
    return Cause("scripted", index, taken_ns, observed_ns, observed_ns, end_ns, end_ns, received_ns)


def chunks() -> Iterable[Sample]:
    for index in range(SECONDS * 1_000_000_000 // CHUNK_NS):
        of = cause(index)
        steps = np.array([[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]], np.float32)
        stamps = (of.observation_stamp_ns, index, of.inference_end_ns + 10**9)
        times = (of.observed_ns, of.inference_start_ns, of.inference_end_ns)
        chunk = ActionChunk("scripted", SPEC.hash, 1, *stamps, steps, *times)
        yield put(KEYS.delta("scripted"), chunk, of.inference_end_ns - ZERO_NS, index)


def commands() -> Iterable[Sample]:
    for index in range(0, SECONDS * 1_000_000_000, TICK_NS):
        newest = index // CHUNK_NS - 1
        of = cause(newest) if newest >= 0 else None
        position = np.array([0.4, 0.0, height_m(index)])
        goal = np.array([0.4, 0.0, height_m(index) + (0.01 if index < SECONDS * 5e8 else 0.0)])
        moving = index < SECONDS * 500_000_000
        twist = np.array([0.0, 0.0, SPEED_M_S if moving else 0.0, 0.0, 0.0, 0.0])
        # A triangle of 80 ms: the jerk has one size all the time.
        phase = index % 80_000_000 / 1e9
        level = JERK_M_S3 * (min(phase, 0.08 - phase) - 0.02)
        acceleration = np.array([level, 0.0, 0.0, 0.0, 0.0, 0.0])
        command = PoseCommand(position, QUAT, twist, acceleration, goal, QUAT, "active", of)
        sample = put(KEYS.command_pose, command, index, index // TICK_NS)
        yield Sample(*_heard(sample, HEARD_MS))


def heard_at(sample: Sample) -> int:
    return sample.received_ns


def _heard(sample: Sample, later_ms: int) -> tuple[Any, ...]:
    received_ns = sample.stamp_ns + later_ms * 1_000_000
    return sample.key, sample.payload, sample.encoding, sample.header, received_ns, None


def states() -> Iterable[Sample]:
    for index in range(0, SECONDS * 1_000_000_000, STATE_NS):
        moving = index < SECONDS * 500_000_000
        position = np.array([0.4, LAG_M, height_m(index)])
        twist = np.array([0.0, 0.0, SPEED_M_S if moving else 0.0, 0.0, 0.0, 0.0])
        seq = index // STATE_NS
        yield put(KEYS.state_pose, PoseState(position, QUAT, twist), index, seq)
        width_m = 0.08 if moving else 0.03
        yield put(KEYS.state_gripper, GripperState(width_m, False, False), index, seq)


def others() -> Iterable[Sample]:
    yield Sample(KEYS.prompt, b"HARD: go up", TEXT, None, ZERO_NS)
    yield put(KEYS.spec("scripted"), SPEC, 0, 0)
    for index in range(0, SECONDS * 1_000_000_000, 200_000_000):
        task = Task(1, True, "HARD: go up", "scripted", 5.0)
        yield put(KEYS.task, task, index, index // 200_000_000)
    for index in range(SECONDS + 1):
        counters = {"refused.stale": 7 + index, "skipped.superseded": index, "samples": 9}
        status = NodeStatus("command", "active", "here", 1, ZERO_NS, counters=counters)
        yield put(KEYS.status("command"), status, index * 999_000_000, index)
    for index in range(0, SECONDS * 30):
        jpeg = encode_jpeg(Image(np.full((48, 64, 3), index, np.uint8)))
        at_ns = index * 1_000_000_000 // 30
        header = Header(ZERO_NS + at_ns, index, "camera#1")
        yield Sample(KEYS.camera_jpeg("front"), jpeg, JPEG, header, header.stamp_wall_ns)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "lab" / "run.mcap"
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
    samples = [*chunks(), *commands(), *states(), *others()]
    for sample in sorted(samples, key=lambda each: each.received_ns):
        out.write(sample)
    out.finish({"dropped": {}})
    return path


@pytest.fixture(scope="module")
def evaluated(recording: Path) -> Evaluation:
    return evaluate_loaded(load_run(recording))


def test_stages_are_measured_and_add_up(evaluated: Evaluation) -> None:
    latency = evaluated.latency()
    assert latency["outbound"].mean == CAMERA_MS
    assert latency["inference"].max == INFERENCE_MS
    assert latency["worker_to_command"].min == RECEIVED_MS
    # The first command of a chunk is that of the next tick of 200 ms; when it was heard is the
    # recorder's own affair.
    assert latency["end_to_end"].p95 == CHUNK_NS / 1e6
    assert latency["inbound"].p50 == CHUNK_NS / 1e6 - CAMERA_MS - INFERENCE_MS


def test_ways_tracking_jerk_and_rest_are_those_that_were_put_in(evaluated: Evaluation) -> None:
    run = evaluated
    way_m = SPEED_M_S * SECONDS / 2
    assert run.name == "lab"
    assert run.path_m == pytest.approx(way_m)
    assert run.command_path_m == pytest.approx(way_m)
    np.testing.assert_allclose(run.tracking_mm, LAG_M * 1e3, atol=POSITION_TOLERANCE_MM)
    np.testing.assert_allclose(run.jerk, JERK_M_S3, rtol=1e-6)
    assert run.active_s == pytest.approx(SECONDS, abs=0.01)
    assert run.idle_s == pytest.approx(SECONDS / 2, abs=0.02)


def test_requests_are_those_of_the_obeyed_worker_and_their_success_is_counted(
    evaluated: Evaluation,
) -> None:
    run = evaluated
    asked = SECONDS * 1_000_000_000 // CHUNK_NS
    assert run.requests == asked
    assert run.executed == asked - 1, "the last chunk came too late for any command"


def test_of_a_recording_that_began_in_a_motion_it_is_not_known_what_was_asked_for(
    recording: Path, evaluated: Evaluation, tmp_path: Path
) -> None:
    """It was begun when the arm stood again: all chunks in it were executed, and it did not move.

    To say that the arm did not do it would blame it for a motion that nobody recorded.
    """
    path, since_ns = tmp_path / "late.mcap", ZERO_NS + SECONDS * 500_000_000
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=since_ns)
    samples = [*chunks(), *commands(), *states(), *others()]
    for sample in sorted(samples, key=lambda each: each.received_ns):
        if sample.key == KEYS.spec("scripted"):  # asked for when the recording began
            out.write(replace(sample, received_ns=since_ns))
        elif sample.received_ns > since_ns:
            out.write(sample)
    out.finish({"dropped": {}})
    run = evaluate_loaded(load_run(path))
    assert run.executed_share is not None
    assert run.executed_share > 0.8
    assert run.reached_share is None
    problems = " ".join(run.problems)
    assert "the recording began after the arm had begun to move" in problems
    assert "how much of what was asked for was done before is not known" in problems
    assert "did not do it" not in problems
    assert run.segments[0].along_m == pytest.approx(0.0, abs=1e-6)
    whole = evaluated
    assert "began after" not in " ".join(whole.problems)


@pytest.mark.parametrize(
    ("times", "why"),
    [
        (12, "limits acted: keep_out shortened at link_6 and shelf (12 times)"),
        (0, "reached 0.0000 m: its chunks were executed, and the arm did not do it"),
    ],
)
def test_what_kept_the_arm_from_what_was_asked_is_named_with_its_place(
    times: int, why: str, tmp_path: Path
) -> None:
    path, since_ns = tmp_path / "held.mcap", ZERO_NS + SECONDS * 500_000_000
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
    held = Event("warning", "limit", "keep_out", "shortened at link_6 and shelf", 0.01, 0.02)
    acted = [put(KEYS.event("command"), held, index * CHUNK_NS, index) for index in range(times)]
    slower = Event("info", "limit", "joint_velocity", "slower at joint2", 1.0, 2.0)
    acted.append(put(KEYS.event("command"), slower, times * CHUNK_NS, times))
    for sample in sorted([*chunks(), *commands(), *states(), *others(), *acted], key=heard_at):
        if sample.received_ns > since_ns or sample.key != KEYS.state_pose:
            out.write(sample)
    out.finish({"dropped": {}})
    run = evaluate_loaded(load_run(path))
    (short,) = [each for each in run.problems if "reached" in each]
    assert why in short
    assert "joint2" not in short


def test_motion_of_a_worker_that_reads_no_prompt_is_no_answer_to_the_prompt(
    tmp_path: Path,
) -> None:
    """Halfway the arm obeys a primitive, which goes somewhere else; the prompt stays as it is."""
    deaf = SPEC.model_copy(
        update={"name": "home", "observation": ObservationSpec(cameras=(), prompt=False)}
    )
    path = tmp_path / "both.mcap"
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
    samples = [put(KEYS.spec("home"), deaf, 0, 0)]
    for sample in (*chunks(), *commands(), *states(), *others()):
        late = sample.stamp_ns >= ZERO_NS + SECONDS * 500_000_000
        if late and sample.key == KEYS.task:
            task = replace(records.decode(Task, sample.payload), worker="home")
            sample = replace(sample, payload=records.encode(task))
        elif late and sample.key == KEYS.delta("scripted"):
            chunk = records.decode(ActionChunk, sample.payload)
            chunk = replace(chunk, worker="home", spec_hash=deaf.hash)
            sample = replace(sample, key=KEYS.delta("home"), payload=records.encode(chunk))
        samples.append(sample)
    for sample in sorted(samples, key=heard_at):
        out.write(sample)
    out.finish({"dropped": {}})
    run = evaluate_loaded(load_run(path))
    assert [each.prompt for each in run.segments] == ["HARD: go up", "(home)"]
    assert [bool(each.asked) for each in run.segments] == [True, False]
    assert run.prompts == ["HARD: go up"]


def test_seams_tell_how_far_the_goal_went(evaluated: Evaluation) -> None:
    run = evaluated
    assert len(run.seam_goal_mm) == SECONDS * 5 - 2
    assert run.seam_goal_mm.max() == pytest.approx(10.0 - SPEED_M_S * TICK_NS / 1e6, abs=0.01)
    assert run.seam_velocity_mm_s.max() == pytest.approx(50.0, abs=0.01), "it stops at once"


def test_a_recording_that_begins_with_the_last_command_of_a_chunk_has_that_seam(
    tmp_path: Path,
) -> None:
    path, begun_ns = tmp_path / "run.mcap", ZERO_NS + 2 * CHUNK_NS - TICK_NS
    out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
    few = [each for each in commands() if 0 <= each.stamp_ns - begun_ns < CHUNK_NS]
    for sample in sorted([*few, *states(), *others()], key=heard_at):
        out.write(sample)
    out.finish({"dropped": {}})
    assert len(evaluate_loaded(load_run(path)).seam_goal_mm) == 1


def motion_out_of_rest(rest_gap_ns: int) -> Iterable[Sample]:
    """Commands at rest for a second, this far apart, then a jerk of one size in every tick."""
    rest_ns, moving_ns = 1_000_000_000, 100_000_000
    stamps_ns = [*range(0, rest_ns, rest_gap_ns), *range(rest_ns, rest_ns + moving_ns, OFTEN_NS)]
    for seq, at_ns in enumerate(stamps_ns):
        t_s = max(at_ns - rest_ns + OFTEN_NS, 0) / 1e9
        values = (JERK_M_S3 * np.array([t_s**3 / 6, t_s**2 / 2, t_s])).tolist()
        position, twist, acceleration = (np.array([value, 0, 0, 0, 0, 0]) for value in values)
        of = cause(int(t_s > 0))
        command = PoseCommand(
            position[:3], QUAT, twist, acceleration, position[:3], QUAT, "active", of
        )
        yield put(KEYS.command_pose, command, at_ns, seq)


def test_commands_that_are_rarer_at_rest_change_neither_jerk_nor_seams(tmp_path: Path) -> None:
    runs = []
    for gap_ns in (OFTEN_NS, 5 * OFTEN_NS):
        path = tmp_path / f"{gap_ns}" / "run.mcap"
        out = RecordingWriter(path, KEYS, profile_yaml="", base_frame="base", began_ns=ZERO_NS)
        samples = [*motion_out_of_rest(gap_ns), *states(), *others()]
        for sample in sorted(samples, key=lambda each: each.received_ns):
            out.write(sample)
        out.finish({"dropped": {}})
        runs.append(evaluate_loaded(load_run(path)))
    often, rarely = runs
    assert rarely.seam_velocity_mm_s == pytest.approx(often.seam_velocity_mm_s, abs=1e-6)
    assert often.seam_velocity_mm_s.max() < 0.01
    # The last gap of the rest counts as one period, in which the motion begins.
    assert rarely.jerk.mean() == pytest.approx(often.jerk.mean(), rel=0.02)


def test_refusals_are_those_of_the_recorded_time(evaluated: Evaluation) -> None:
    run = evaluated
    assert (run.refusals, run.skipped) == ({"stale": SECONDS}, {"superseded": SECONDS})


def test_the_drift_off_the_asked_axis_and_the_gripper_are_told(evaluated: Evaluation) -> None:
    (segment,) = evaluated.segments
    assert segment.along_m == pytest.approx(SPEED_M_S * SECONDS / 2)
    assert segment.drift_m == pytest.approx(0.0, abs=1e-12)
    assert segment.width_m == (0.08, 0.03)
    assert evaluated.row()["gripper_travel_m"] == pytest.approx(0.05)


def test_the_strip_shows_the_pictures_that_chunks_were_made_of(recording: Path) -> None:
    views = evaluate_loaded(load_run(recording), pictures=4).views
    assert [view.model for view in views] == [False, True] * 4
    np.testing.assert_allclose([v.t_s for v in views[::2]], [0.0, 1.2, 2.4, 3.8], atol=0.05)


def test_a_recording_that_was_cut_off_is_evaluated_up_to_there(
    recording: Path, evaluated: Evaluation, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    whole = recording.read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    run = evaluate_loaded(load_run(cut))
    assert any("cut off or damaged after" in problem for problem in run.problems)
    assert 0 < run.requests <= evaluated.requests


def test_a_run_that_moves_to_another_time_and_robot_keeps_its_latencies(recording: Path) -> None:
    later_ns = 77_777_777
    ghost = Keys("ghost", "lab")
    restamper = Restamper(ZERO_NS, ZERO_NS + later_ns, 1.0, KEYS, ghost, "abc")
    for entry in open_recording(recording).entries():
        moved = restamper.move(entry)
        assert moved.key == entry.key.replace("vla/panda", "lab/ghost")
        assert moved.received_ns == entry.received_ns + later_ns
        if entry.header is None:
            assert moved.payload == entry.payload
            continue
        assert moved.header is not None
        assert moved.header.stamp_wall_ns == entry.header.stamp_wall_ns + later_ns
        assert moved.header.seq == entry.header.seq
        node, start = entry.header.source.split("#")
        assert moved.header.source == f"{node}#abc{start}"
        if entry.kind is PoseCommand and (cause := entry.record().cause):
            found = records.decode(PoseCommand, moved.payload).cause
            for name in Cause.__dataclass_fields__:
                if name.endswith("_ns"):
                    assert getattr(found, name) == getattr(cause, name) + later_ns
        if entry.kind is ActionChunk:
            found = records.decode(ActionChunk, moved.payload)
            assert found.valid_until_ns == entry.record().valid_until_ns + later_ns


def test_what_a_robot_sends_after_a_restart_is_no_repetition_of_what_it_sent_before() -> None:
    restamper = Restamper(ZERO_NS, ZERO_NS, 1.0, KEYS, KEYS, "abc")
    seen = SingleWriterFilter(sources=2)
    for start in ("sim#first", "sim#second", f"sim#{'x' * 124}"):
        for seq in range(3):
            sample = Sample(KEYS.state_pose, b"", MSGPACK, Header(ZERO_NS, seq, start), ZERO_NS)
            header = restamper.move(sample).header
            assert header is not None
            seen.check(header)
            seen.accept(header)


def test_at_twice_the_speed_everything_takes_half_the_time(recording: Path) -> None:
    restamper = Restamper(ZERO_NS, ZERO_NS, 2.0, KEYS, KEYS, "abc")
    entries = list(open_recording(recording).entries())
    moved = [restamper.move(entry) for entry in entries]
    assert moved[-1].received_ns - ZERO_NS == (entries[-1].received_ns - ZERO_NS) // 2
    assert restamper.moved_ns(0) == 0


# -- pictures -------------------------------------------------------------------------------------
PROVENANCE = {"profile": "panda_bricks", "command": "vla-zenoh demo", "host": "lab", "code": "1.2"}
TASK = {"prompt": "push the red brick left", "success": False, "said": "off course"}


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a demo that says where it comes from, and its verdict."""
    path = tmp_path_factory.mktemp("judged") / "run.mcap"
    text = to_yaml(load_profile("panda_bricks"))
    out = RecordingWriter(
        path, KEYS, profile_yaml=text, base_frame="base", began_ns=ZERO_NS, about=PROVENANCE
    )
    samples = [*chunks(), *commands(), *states(), *others()]
    for sample in sorted(samples, key=lambda each: each.received_ns):
        out.write(sample)
    out.finish({"dropped": {}, TASKS: [TASK], "seed": 7})
    return path


@pytest.fixture(scope="module")
def judged_run(judged: Path) -> Evaluation:
    return evaluate_loaded(load_run(judged))


def test_a_run_says_where_it_comes_from(judged_run: Evaluation) -> None:
    about = judged_run.about
    assert about.items() >= PROVENANCE.items()
    assert about["seed"] == "7"
    assert about["model"] == "scripted"
    assert about["recorded"].startswith("2023-11-1")


def test_the_verdicts_on_its_tasks_are_those_of_the_judge(
    judged_run: Evaluation, evaluated: Evaluation
) -> None:
    (verdict,) = judged_run.verdicts
    assert (verdict.prompt, verdict.success, verdict.said) == tuple(TASK.values())
    assert evaluated.verdicts == []


def test_a_page_of_one_run_shows_provenance_verdict_curves_and_video(judged: Path) -> None:
    run = evaluate_loaded(load_run(judged), pictures=2)
    text = page([run], {})
    body = text[text.index("<body>") :]
    assert f"<h1>Evaluation of {run.name}</h1>" in body
    assert all(value in body for value in PROVENANCE.values())
    assert 'class="bad"' in body
    assert "off course" in body
    assert 'src="data:video/mp4;base64,' in body
    for part in ("time1", "histogram1", "path1"):
        assert f'draw("{part}", {{"data"' in body


def test_a_run_is_named_after_its_folder_from_within_it_too(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(recording.parent)
    run = evaluate_loaded(load_run(Path("run.mcap")))
    assert run.name == recording.parent.name
    assert "<h1>Evaluation of lab</h1>" in page([run], {})


def test_a_page_counts_only_runs(judged_run: Evaluation, evaluated: Evaluation) -> None:
    runs = [judged_run, evaluated]
    text = page(runs, {})
    assert "<h1>Evaluation of 2 runs</h1>" in text
    assert text.count("<section id=") == len(runs)


def test_the_film_is_as_long_as_the_run_and_shows_every_camera(
    judged: Path, tmp_path: Path
) -> None:
    run = load_run(judged)
    frames = write_film(tmp_path / "a.mp4", run, Film(height_px=48, rate_hz=10))
    assert frames == pytest.approx(run.seconds * 10, abs=1)
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_COUNT)) == (64, frames)


def test_a_reset_and_a_gap_break_a_curve() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 0.3, 2.0])
    x_m = np.array([0.0, 0.01, 0.5, 0.51, 0.52])
    position_m = np.column_stack([x_m, 0 * x_m, 0 * x_m])
    times, values = unbroken(PlotTrace(t_s, position_m, position_m))
    assert np.flatnonzero(np.isnan(times)).tolist() == [2, 5]
    assert np.isnan(values[[2, 5]]).all()


# -- the command ----------------------------------------------------------------------------------
def test_what_cannot_be_evaluated_does_not_stop_the_rest(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "none.csv").write_text("a,b\n")
    out, html, table = tmp_path / "out.json", tmp_path / "out.html", tmp_path / "rows.csv"
    paths = [str(tmp_path / name) for name in ("cut.mcap", "none.csv", "missing.mcap")]
    outputs = [word for path in (out, html, table) for word in ("-o", str(path))]
    done = CliRunner().invoke(
        app, ["eval", *paths, str(recording), *outputs], env={"COLUMNS": "200"}
    )
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    assert [run["record_id"] for run in found["runs"]] == ["lab"]
    assert list(found["faults"]) == paths
    assert done.stderr.count("not evaluated") == 3
    assert found["overall"]["e2e_mean_ms"] == found["runs"][0]["e2e_mean_ms"]
    with table.open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["trans_total_m"]) == found["runs"][0]["trans_total_m"]
    assert "lab" in html.read_text()


def test_nothing_to_evaluate_is_an_error(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["eval", str(tmp_path)])
    assert done.exit_code == 1
    assert "holds no recording" in " ".join(done.stderr.split())  # it is wrapped


def test_nothing_is_written_where_nothing_could_be_evaluated(tmp_path: Path) -> None:
    (tmp_path / "run.part.mcap").write_bytes(b"")
    page = tmp_path / "run.html"
    done = CliRunner().invoke(app, ["eval", str(tmp_path / "run.mcap"), "-o", str(page)])
    assert done.exit_code == 1
    assert "run.part.mcap is there: its recorder still runs" in " ".join(done.stderr.split())
    assert not page.exists()


def test_other_files_in_a_folder_are_passed_over(recording: Path) -> None:
    (recording.parent / "poses.csv").write_text("heard_wall_ns,x_m\n1,2\n")
    runs, faults = evaluate([recording.parent])
    assert [run.name for run in runs] == ["lab"]
    assert faults == {}


def test_the_page_needs_no_network_and_no_prompt_breaks_it(recording: Path) -> None:
    run = evaluate_loaded(load_run(recording))
    run.marks = [(0.0, "</script><script>alert(1)</script><b>")]
    run.segments = [replace(run.segments[0], prompt=run.marks[0][1])]
    text = page([run], {})
    body = text[text.index("<body>") :]
    assert "<script>alert" not in body
    assert "&lt;/script&gt;" in body
    for source in ('src="http', "src='http", "<link", "@import"):
        assert source not in text[: text.index("<script>")] + body
