from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.cli.nodes import latch_file
from vla_zenoh.profile import load_profile
from vla_zenoh.runtime.kept_text import KeptText
from vla_zenoh.runtime.process import RUN_FOLDER_VARIABLE


def test_a_node_started_by_hand_finds_the_stop_of_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(RUN_FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    profile = load_profile("panda_sim")
    for node in ("sim", "command"):
        before = KeptText(latch_file(profile, node))
        before.set(f"stop of {node}")
        before.close()
    for node in ("sim", "command"):
        again = KeptText(latch_file(profile, node))
        assert again.read() == f"stop of {node}"
        again.set(None)
        again.close()
        assert KeptText(latch_file(profile, node)).read() is None


def test_robots_of_one_host_do_not_share_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(RUN_FOLDER_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    profile = load_profile("panda_sim")
    other = profile.robot.model_copy(update={"name": "other"})
    renamed = profile.model_copy(update={"robot": other})
    assert latch_file(profile, "sim") != latch_file(renamed, "sim")


def test_up_says_in_which_folder_the_stop_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(RUN_FOLDER_VARIABLE, str(tmp_path))
    assert latch_file(load_profile("panda_sim"), "sim") == tmp_path / "stopped-panda-sim"
