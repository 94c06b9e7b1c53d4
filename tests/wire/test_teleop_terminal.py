"""``vla-zenoh teleop`` in a real terminal drives a real chain."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from camera_rig import until
from chain import LONG_PATIENCE_S, READY_PATIENCE_S, Chain
from recording_rig import recording
from teleop_rig import Screen, teleop
from typed import typed
from vla_zenoh_dataset.episodes import episodes_of
from vla_zenoh_teleop.keyboard import END

from vla_zenoh.codec import records
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.types import GripperState

ROBOT_PATIENCE_S = LONG_PATIENCE_S
MOVED_M = 0.03
OFF_AXIS_M = 0.005
SPEED_M_S = 0.06
FASTEST = 1.8
"""Of the asked speed: the measured arm swings, and catches up with a reference that was late."""
AFTER_M = 0.03
"""On after the key was let go: 0.15 s until that is known, a chunk and its cover, the brake, and a
tenth of a second for a busy computer."""


def activate_by_key(chain: Chain, screen: Screen) -> None:
    """Enter, again whenever preflight finds something missing."""
    until_accepted(chain, screen, b"\r", lambda: chain.state() == "active", "activate_refused")


def take_by_key(chain: Chain, screen: Screen) -> None:
    """Tab, again whenever preflight finds something missing: the model keeps the arm then."""

    def taken() -> bool:
        return chain.client.task is not None and chain.client.task.worker == "teleop"

    until_accepted(chain, screen, b"\t", taken, "worker_refused")


def until_accepted(
    chain: Chain, screen: Screen, key: bytes, accepted: Callable[[], bool], refusal: str
) -> None:
    """Press `key` until it is accepted, once for each refusal."""
    give_up_s = time.monotonic() + READY_PATIENCE_S
    while not accepted():
        assert time.monotonic() < give_up_s, chain.story()
        refused = chain.counter(f"refused.{refusal}")
        screen.type(key)
        chain.until(
            "an answer",
            lambda before=refused: accepted() or chain.counter(f"refused.{refusal}") > before,
        )


def test_a_held_key_moves_the_arm_and_a_released_one_stops_it(chain: Chain) -> None:
    with teleop(chain) as screen:
        chain.client.set_worker("teleop")
        chain.activate_when_ready()
        start_m = chain.reference_m()
        chain.recorder.forget()
        screen.hold(b"r", lambda: chain.reference_m()[2] > start_m[2] + MOVED_M)
        let_go_m = chain.reference_m()
        chain.wait_still()
        end_m = chain.reference_m()
        assert 0 <= end_m[2] - let_go_m[2] < AFTER_M
        assert np.abs(end_m - start_m)[:2].max() < OFF_AXIS_M
        fastest_m_s = chain.recorder.track().speed_m_s.max()
        print(f"{fastest_m_s:.3f} m/s, {(end_m - let_go_m)[2] * 1e3:.1f} mm on")
        assert SPEED_M_S / FASTEST < fastest_m_s < SPEED_M_S * FASTEST
        assert chain.state() == "active", "who lets go keeps the arm"
        assert chain.refused().get("command.shape", 0) == 0
        # A terminal that tells releases: one press and its repeats, then a release.
        screen.type(b"\x1b[?11u\x1b[102u")
        screen.hold(b"\x1b[102;1:2u", lambda: chain.reference_m()[2] < end_m[2] - MOVED_M)
        screen.type(b"\x1b[102;1:3u")
        chain.wait_still()
        screen.type(b" ")
        chain.until("the gripper shuts", lambda: _width_m(chain) < 0.01)


def _width_m(chain: Chain) -> float:
    with chain.session.declare_subscriber(chain.profile.keys.state_gripper) as widths:
        return records.decode(GripperState, widths.recv().payload.to_bytes()).width_m


def test_it_takes_the_arm_from_a_model_and_gives_it_back_as_its_recording_says(
    chain: Chain, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    with recording(chain, path, name="of-takeover") as recorder, teleop(chain) as screen:
        chain.client.set_worker("scripted")
        chain.move()
        take_by_key(chain, screen)
        height_m = chain.reference_m()[2]
        screen.hold(b"r", lambda: chain.reference_m()[2] > height_m + MOVED_M)
        chain.wait_still()
        assert chain.state() == "active", chain.story()
        screen.type(b"\t")
        chain.until("the model has it back", lambda: chain.client.task.worker == "scripted")
        chain.until("it moves on", chain.moves)
        screen.type(b"x")
        chain.until("stopped", lambda: chain.state() == "stopped")
        chain.until("the person reads it", lambda: b"CONFIRMED: robot " in screen.shown)
    assert not recorder.recorded.failure
    run = load_run(path)
    (episode,) = [each for each in episodes_of(run) if "teleop" in each.workers]
    assert (episode.worker, episode.workers) == ("scripted", ["scripted", "teleop"])
    ((since_ns, until_ns),) = [(a, b) for a, b, worker in episode.led if worker == "teleop"]
    meanwhile = {
        chunk.record.worker
        for chunk in run.chunks
        if since_ns < chunk.header.stamp_wall_ns < until_ns
    }
    assert meanwhile == {"scripted", "teleop"}, "the model goes on in shadow"
    led = [frame.intervention for frame in episode.frames]
    assert not led[0]
    assert not led[-1]
    up_m = sum(float(frame.action[2]) for frame in episode.frames if frame.intervention)
    assert up_m > MOVED_M / 2


def test_a_leader_arm_takes_the_arm_from_a_model_and_gives_it_back(
    chain: Chain, tmp_path: Path
) -> None:
    go = tmp_path / "go"
    leader = Path(__file__).parents[1] / "leader_arm.py"
    with teleop(chain, "--leader", str(leader), "--set", f"go={go}") as screen:
        chain.client.set_worker("scripted")
        chain.move()
        take_by_key(chain, screen)
        chain.wait_still()
        start_m = chain.reference_m()
        go.write_text("")
        chain.until("the arm follows", lambda: chain.reference_m()[1] > start_m[1] + MOVED_M)
        go.write_text("gone")
        chain.wait_still()
        until("it is told", lambda: b"the cable is out" in screen.shown)
        screen.type(b"\t")
        chain.until("the model has it back", lambda: chain.client.task.worker == "scripted")
        chain.until("it moves on", chain.moves)
        assert chain.client.deactivate()


def test_ctrl_c_in_motion_ends_it_stops_the_arm_and_restores_the_terminal(chain: Chain) -> None:
    with teleop(chain) as screen:
        assert screen.settings() != screen.before
        take_by_key(chain, screen)
        activate_by_key(chain, screen)
        screen.hold(b"a", chain.moves)
        screen.type(b"\x03")
        assert screen.process.wait(10) == 0
        until("everything is shown", lambda: END in screen.shown)
        assert screen.settings() == screen.before
        chain.until("nobody is obeyed", lambda: chain.state() == "inactive")
        chain.wait_still()
        assert b"Traceback" not in screen.shown


def test_without_a_terminal_it_says_so(chain: Chain, capsys: pytest.CaptureFixture[str]) -> None:
    done = typed(capsys, "teleop", "--profile", str(chain.profile_file))
    assert done.code == 1
    assert "teleop needs a terminal" in done.stderr
