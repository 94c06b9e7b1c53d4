"""What the flywheel reads out of logs and rows, without a training."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.flywheel.cells import compare_cells, losses
from benchmarks.flywheel.figures import write_figures

LOG = (
    "Training:   0%| | 50/12000\rINFO 2026 ot_train.py:641 step:50 smpl:400 ep:5 epch:0.09 "
    "loss:0.611 grdn:9.1 lr:1.0e-04 updt_s:0.2 data_s:0.05 smp/s:30 l1_loss:0.611\n"
    "INFO 2026 ot_train.py:641 step:1K smpl:9K ep:103 epch:2.07 loss:0.255 grdn:16.485 "
    "lr:1.0e-04 updt_s:0.217 data_s:0.055 smp/s:29 l1_loss:0.255\n"
)


def cell(seed: int, *, success: bool = True, steps: int = 90, end: str = "a") -> dict[str, object]:
    return {"seed": seed, "success": success, "steps": steps, "end": end}


def test_the_loss_is_read_over_epochs_from_the_trainers_log(tmp_path: Path) -> None:
    log = tmp_path / "act.log"
    log.write_text(LOG, "utf-8")
    assert losses(log) == [(0.09, 0.611), (2.07, 0.255)]


@pytest.mark.parametrize(
    ("changed", "same", "same_end"),
    [({}, 2, 2), ({"steps": 91}, 1, 2), ({"success": False}, 1, 2), ({"end": "b"}, 2, 1)],
)
def test_two_evaluations_are_compared_seed_by_seed(
    changed: dict[str, object], same: int, same_end: int
) -> None:
    ours = [cell(7), cell(8)]
    theirs = [{**cell(8), **changed}, cell(7)]
    found = compare_cells(ours, theirs)
    assert (found["of"], found["same"], found["same_end"]) == (2, same, same_end)
    assert found["differing_seeds"] == ([] if same == 2 else [8])


def test_figures_are_drawn_of_what_was_done(tmp_path: Path) -> None:
    rows = {
        "training": {"steps": 100, "l1_by_epoch": [(0.1, 0.6), (2.0, 0.2)]},
        **{
            f"{way}-{delay_ms}ms": {
                "delay_ms": float(delay_ms),
                "success_rate": 0.5,
                "steps_to_success_p50": 90.0 if delay_ms else None,
                "wilson_95": [0.1, 0.9],
                "all": [cell(1000), cell(1001)],
            }
            for way in ("stand", "blend")
            for delay_ms in (0, 100)
        },
    }
    files = write_figures(tmp_path / "figures", rows)
    names = {file.name for file in files}
    kinds = ("svg", "pdf")
    assert names == {f"flywheel_{each}.{kind}" for each in ("training", "delay") for kind in kinds}
    drawn = (tmp_path / "figures" / "flywheel_delay.svg").read_text("utf-8")
    assert "n = 2 episodes a point, seeds 1000 to 1001" in drawn
    assert "arm stands meanwhile" in drawn
    assert "replaced" not in drawn


def test_of_nothing_there_is_no_figure(tmp_path: Path) -> None:
    assert write_figures(tmp_path, {}) == []
