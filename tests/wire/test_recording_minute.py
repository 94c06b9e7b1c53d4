"""A minute of a whole lab: two cameras at full size, recorded and replayed."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from camera_rig import free_endpoint
from chain import command_line, running_chain
from recording_rig import assert_same, ghost_of, recording

from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.recording.run import load_run, pictures

LAB = """\
extends: panda_sim
task: {{prompt: hold, rate_hz: 5, worker: scripted}}
session:
  listen: [{endpoint}]
  connect: [{endpoint}]
"""
LAB_S = 60.0


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_minute_of_two_cameras_is_recorded_whole_and_replayed(tmp_path: Path) -> None:
    lab, first, again = (tmp_path / name for name in ("lab.yaml", "first.mcap", "again.mcap"))
    lab.write_text(LAB.format(endpoint=free_endpoint()))
    words = ("record", "--output", str(first), "--seconds", f"{LAB_S:g}", "--json")
    with running_chain(tmp_path, profile_file=lab) as chain:
        chain.activate_when_ready()
        results: list[Any] = []
        thread = threading.Thread(
            target=lambda: results.append(command_line(*words, profile=lab, timeout_s=2 * LAB_S))
        )
        thread.start()
        time.sleep(8.0)
        for prompt in ("go up", "yaw left", "go down", "yaw right"):
            chain.client.set_prompt(f"HARD: {prompt} x20", timeout_s=10.0)
            time.sleep(8.0)
        chain.client.deactivate()
        thread.join()
        with recording(chain, again, ghost_of(chain)):
            done = command_line(
                *("replay", str(first), "--robot", "ghost", "--json"),
                profile=lab,
                timeout_s=2 * LAB_S,
            )
    recorded, replayed = json.loads(results[0].stdout), json.loads(done.stdout)
    run = load_run(first)
    print(
        f"\nrecorded {recorded['size_bytes'] / recorded['seconds'] / 1e3:.0f} kB/s: "
        f"{sum(recorded['samples'].values())} samples, pictures {dict(run.picture_counts)}; "
        f"replayed, time between samples off by {replayed['interval_error_ms']} ms"
    )
    assert recorded["dropped"] == {}
    for camera in ("front", "wrist"):
        taken = [picture.seq for picture in pictures(run.file, camera)]
        assert taken == list(range(taken[0], taken[0] + len(taken))), "a picture is missing"
    assert_same(evaluate_loaded(load_run(first)), evaluate_loaded(load_run(again)))
