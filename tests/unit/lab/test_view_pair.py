"""A recorded robot of two arms in Rerun: each arm below its base, with its own curves."""

from __future__ import annotations

import numpy as np
import pytest
from pair_recording_rig import SPEED_M_S, WIDTH_M, pair_spec, write_pair_run
from test_view import stream_to
from view_rig import Shown
from vla_zenoh_view.rerun_logger import RerunLogger

from vla_zenoh.lab.recording.reader import open_recording
from vla_zenoh.profile import load_profile

HERE = "Transform3D:translation"


def of_deltas() -> dict[str, object]:
    return {"space": "tcp", "joints": (), "kind": "delta", "gripper": "absolute_m"}


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    folder = tmp_path_factory.mktemp("view_pair")
    file = open_recording(write_pair_run(folder / "run.mcap", of=pair_spec(**of_deltas())))
    stream = stream_to(folder / "run.rrd")
    show = RerunLogger(load_profile("two_pandas_sim"), stream, keys=file.keys)
    for entry in file.entries():
        show.log(entry)
    show.close()
    assert not [why for why in show.rejected if "state" in why or "delta" in why]
    stream.disconnect()
    return Shown(folder / "run.rrd")


def test_each_arm_stands_where_its_base_is(shown: Shown) -> None:
    assert "Transform3D:translation" in shown.static("world/left")
    assert "Transform3D:translation" in shown.static("world/right")
    for part in SPEED_M_S:
        assert any(path.startswith(f"world/{part}/robot/panda_hand/") for path in shown.paths)
        assert f"world/{part}/workspace" in shown.paths


def test_poses_and_chunks_are_those_of_the_part(shown: Shown) -> None:
    for part, speed_m_s in SPEED_M_S.items():
        way_m = np.array([place[0] for place in shown.values(f"world/{part}/pose/measured", HERE)])
        seconds = np.ptp(shown.stamps_ns(f"world/{part}/pose/measured")) / 1e9
        assert way_m[-1, 2] - way_m[0, 2] == pytest.approx(speed_m_s * seconds, rel=0.02)
        assert shown.values(f"world/{part}/chunk/pair_model", "LineStrips3D:strips")


def test_curves_are_those_of_the_part(shown: Shown) -> None:
    for part, speed_m_s in SPEED_M_S.items():
        found = shown.scalars(f"plot/speed/{part}/measured")
        assert found == pytest.approx([speed_m_s * 1e3] * len(found))
        widths = shown.scalars(f"plot/gripper/{part}/measured")
        assert widths == pytest.approx([WIDTH_M[part] * 1e3] * len(widths))
    assert shown.scalars("plot/latency/inference")
