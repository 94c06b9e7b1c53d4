"""Figures for a paper: their size, their looks, their captions, and what is refused."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner
from vla_zenoh_benchmarks.paired_tasks import read_run
from vla_zenoh_figures.latency import latency
from vla_zenoh_figures.motion import motion
from vla_zenoh_figures.style import COLUMN_IN, LOOKS, PAGE_IN, FigureError, write
from vla_zenoh_figures.success import Result, success

from vla_zenoh.codec import records
from vla_zenoh.keys import Keys
from vla_zenoh.lab.evaluation.result import Evaluation, PlotTrace
from vla_zenoh.lab.recording.sample import MSGPACK, TEXT, Sample
from vla_zenoh.lab.recording.writer import RecordingWriter
from vla_zenoh.program.main import app
from vla_zenoh.types import Header, PoseState

POINTS_PER_IN = 72
LEAST_APART = 20.0
"""Between two colours in CIELAB as a person without one kind of cones sees them; 2.3 is just
noticeable."""
CONES = {
    "protan": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deutan": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "tritan": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}
"""Of linear RGB: G. Machado et al., IEEE Trans. Visualization 15, 2009, severity 1."""


def run(name: str = "lab", speed_m_s: float = 0.05) -> Evaluation:
    """Goes up for two seconds."""
    t_s = np.arange(0.0, 2.0, 0.01)
    position_m = np.array([0.4, 0.0, 0.2]) + np.outer(t_s, [0.0, 0.0, speed_m_s])
    trace = PlotTrace(t_s, position_m, np.zeros((len(t_s), 3)), np.full(len(t_s), speed_m_s))
    return Evaluation(
        name=name,
        requests=20,
        stages_ms={"end_to_end": np.arange(10.0, 30.0)},
        path_m=2 * speed_m_s,
        tracking_mm=np.full(10, 1.5),
        measured=trace,
        commanded=trace,
        marks=[(0.5, "go up")],
    )


def result_json(model: str, successes: int, trials: int = 20) -> str:
    episodes = [
        {
            "seed": 100 + index,
            "family": ("put", "push")[index % 2],
            "success": index < successes,
            "failure": "",
        }
        for index in range(trials)
    ]
    told = {"model": model, "options": {}, "scene": "bricks", "mode": "lockstep", "delay_ms": 40}
    return json.dumps({**told, "all": episodes})


def result(model: str, successes: int) -> Result:
    return Result(model, read_run(result_json(model, successes).encode(), model))


def drawing(name: str, width_in: float = COLUMN_IN) -> Any:
    if name == "motion":
        return motion([run("a"), run("b", 0.1)], width_in)
    if name == "latency":
        return latency([run("a"), run("b")], width_in, "end_to_end")
    return success([result("a", 12), result("b", 19)], width_in)


@pytest.mark.parametrize("name", ["motion", "latency", "success"])
def test_a_figure_has_the_width_that_was_asked_for_and_text_of_8_points(
    tmp_path: Path, name: str
) -> None:
    width_in = (COLUMN_IN + PAGE_IN) / 2
    drawn = drawing(name, width_in)
    for end in (".pdf", ".svg", ".png"):
        write(drawn, tmp_path / f"a{end}")
    box = re.search(rb"/MediaBox \[ *0 0 ([\d.]+)", (tmp_path / "a.pdf").read_bytes())
    assert box is not None
    assert float(box[1]) == pytest.approx(width_in * POINTS_PER_IN, abs=0.01)
    svg = (tmp_path / "a.svg").read_text()
    wide = re.search(r'<svg [^>]*width="([\d.]+)pt"', svg)
    assert wide is not None
    assert float(wide[1]) == pytest.approx(width_in * POINTS_PER_IN, abs=0.01)
    sizes = set(re.findall(r"font: ([\d.]+)px", svg)) | set(re.findall(r"font-size: ([\d.]+)", svg))
    assert sizes == {"8"}, "and it is text, not outlines"
    pixels = cv2.imread(str(tmp_path / "a.png"))
    assert pixels is not None
    assert pixels.shape[1] == round(width_in * 300)
    assert (pixels < 128).any()


def test_the_same_data_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "two"):
        drawn = drawing("latency")
        for end in (".pdf", ".svg", ".png"):
            write(drawn, tmp_path / f"{name}{end}")
    for end in (".pdf", ".svg", ".png"):
        assert (tmp_path / f"one{end}").read_bytes() == (tmp_path / f"two{end}").read_bytes()


@pytest.mark.parametrize("kind", CONES)
def test_colours_are_told_apart_without_one_kind_of_cones(kind: str) -> None:
    values = [[int(look.colour[at : at + 2], 16) / 255 for at in (1, 3, 5)] for look in LOOKS]
    srgb = np.array(values)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(CONES[kind]).T, 0, 1)
    back = np.where(seen <= 0.0031308, seen * 12.92, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = cv2.cvtColor(back[None].astype(np.float32), cv2.COLOR_RGB2Lab)[0]
    for one, other in itertools.combinations(range(len(LOOKS)), 2):
        assert np.linalg.norm(lab[one] - lab[other]) > LEAST_APART, (LOOKS[one], LOOKS[other])


def test_runs_are_told_apart_without_colours() -> None:
    assert len({look.dash for look in LOOKS}) == len({look.marker for look in LOOKS}) == len(LOOKS)


def test_captions_have_numbers_of_trials_seeds_and_intervals() -> None:
    said = drawing("latency").caption
    assert "a: n = 20 requests, median 19.5 ms, 95th percentile 28.1 ms" in said
    said = drawing("motion").caption
    assert "chunks n = 20, path 0.100 m" in said
    assert "median 1.5 mm" in said
    caption = drawing("success").caption
    assert "interval at 95 % (Wilson)" in caption
    said = "b: 19 of n = 20 episodes (76 to 99 %), 20 seeds, 100 to 119, lockstep, delay 40 ms."
    assert said in caption


def test_an_arm_at_rest_is_a_line_and_not_its_noise() -> None:
    figure = motion([run("still", 1e-9)], COLUMN_IN).figure
    for axis in figure.axes:
        low, high = axis.get_ylim()
        assert high - low >= 0.01


@pytest.mark.parametrize("count", [2, len(LOOKS)])
def test_what_cannot_be_drawn_is_named(count: int) -> None:
    few = [run(str(index)) for index in range(count)]
    motion(few, COLUMN_IN)
    with pytest.raises(FigureError, match="at most 5 can be told apart"):
        motion([run(str(index)) for index in range(len(LOOKS) + 1)], COLUMN_IN)
    few[1].measured = None
    with pytest.raises(FigureError, match="no measured pose in: 1"):
        motion(few, COLUMN_IN)
    few[1].stages_ms = {"end_to_end": np.array([np.nan])}
    with pytest.raises(FigureError, match="1 has no request whose stage end_to_end is known"):
        latency(few, COLUMN_IN, "end_to_end")


# -- the commands ---------------------------------------------------------------------------------
@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """An arm that goes up by 10 cm in a second."""
    keys, path = Keys("panda"), tmp_path / "lab" / "run.mcap"
    out = RecordingWriter(path, keys, profile_yaml="", base_frame="base", began_ns=10**18)
    out.write(Sample(keys.prompt, b"HARD: go up", TEXT, None, 10**18))
    for index in range(200):
        stamp_ns = 10**18 + index * 5_000_000
        position_m, twist = np.array([0.4, 0.0, 0.2 + 5e-4 * index]), np.array([0, 0, 0.1, 0, 0, 0])
        state = records.encode(PoseState(position_m, np.array([1.0, 0, 0, 0]), twist))
        header = Header(stamp_ns, index, "arm#1")
        out.write(Sample(keys.state_pose, state, MSGPACK, header, stamp_ns + 1_000_000))
    out.finish({"dropped": {}})
    return path


def invoke(*words: object) -> Any:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_a_recording_becomes_a_figure_with_its_caption(tmp_path: Path, recording: Path) -> None:
    done = invoke("figure", "motion", recording, "-o", tmp_path / "a.pdf", "--page", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["file"] == str(tmp_path / "a.pdf")
    assert told["width_in"] == PAGE_IN
    assert "Motion of the TCP. lab: prompts n = 0, chunks n = 0" in told["caption"]
    assert re.search(r"path 0\.(099|100) m", told["caption"])
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


def test_results_of_one_model_have_the_names_of_their_files(tmp_path: Path) -> None:
    for name, successes in (("early", 8), ("late", 16)):
        (tmp_path / f"{name}.json").write_text(result_json("mine", successes))
    files = [tmp_path / "early.json", tmp_path / "late.json"]
    done = invoke("figure", "success", *files, "-o", tmp_path / "a.svg")
    assert done.exit_code == 0, done.output
    assert "early: 8 of n = 20" in done.stdout
    svg = (tmp_path / "a.svg").read_text()
    assert all(f">{word}</text>" in svg for word in ("early", "late", "put", "push", "all"))


def test_nothing_is_overwritten_and_what_is_wrong_is_named(tmp_path: Path, recording: Path) -> None:
    (tmp_path / "a.pdf").write_text("mine")
    (tmp_path / "none").mkdir()
    rows = {
        (
            "motion",
            recording,
            "-o",
            tmp_path / "a.pdf",
        ): "exists; give another --output, or --force",
        ("motion", recording, "-o", tmp_path / "a.jpg"): "must end in .pdf, .svg, .png",
        ("motion", tmp_path / "none", "-o", tmp_path / "b.pdf"): "holds no recording",
        ("motion", tmp_path / "absent.mcap", "-o", tmp_path / "b.pdf"): "absent.mcap",
        ("latency", recording, "-o", tmp_path / "b.pdf"): "no request whose stage end_to_end",
        ("latency", recording, "-o", tmp_path / "b.pdf", "--stage", "all"): "end_to_end, outbound",
        ("success", recording, "-o", tmp_path / "b.pdf"): "is no result of",
        ("success", tmp_path / "none", "-o", tmp_path / "b.pdf"): "cannot be read",
    }
    for words, says in rows.items():
        done = invoke("figure", *words)
        assert done.exit_code != 0
        assert says in " ".join((done.output + str(done.exception)).split()), (words, done.output)
    assert (tmp_path / "a.pdf").read_text() == "mine"
    assert not (tmp_path / "b.pdf").exists()
