"""`bench sim` does as the packages' own loops do: their experts, episode by episode."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from benchmark_rig import ROOT
from chain import command_line

from vla_zenoh.policy.loader import find_model
from vla_zenoh.runtime.environments import environment_command

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
MAKE_S, RUN_S = 400.0, 240.0


@pytest.mark.parametrize(
    ("benchmark", "expert", "loop", "tasks"),
    [
        ("metaworld", "metaworld_expert", "metaworld_loop.py", "reach-v3,drawer-open-v3,push-v3"),
        ("ogbench", "ogbench_expert", "ogbench_loop.py", "0"),
        ("so101", "so101_expert", "so101_loop.py", "0"),
    ],
)
def test_an_expert_through_our_keys_succeeds_in_the_same_episodes_and_steps(
    tmp_path: Path, benchmark: str, expert: str, loop: str, tasks: str
) -> None:
    python = [*environment_command(find_model(expert)), "python"]
    made = subprocess.run(
        [*python, "-c", ""], capture_output=True, text=True, timeout=MAKE_S, check=False
    )
    if made.returncode:
        pytest.skip(f"no environment: {made.stderr.strip()[-300:]}")
    out = tmp_path / "run"
    words = ["bench", "sim", benchmark, "--worker", expert, "--tasks", tasks, "-n", "2"]
    done = command_line(*words, "-o", str(out), "--videos", "0", timeout_s=RUN_S)
    assert done.returncode == 0, done.stderr
    compared = [*python, str(ROOT / "benchmarks" / loop), str(out)]
    again = subprocess.run(compared, capture_output=True, text=True, timeout=RUN_S, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
