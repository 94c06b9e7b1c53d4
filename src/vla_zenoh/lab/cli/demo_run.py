"""``vla-zenoh demo --prompt "HARD: ..."``: a fixed motion, compared with what its prompt asks."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import typer

from vla_zenoh.cli.output import console, new_table
from vla_zenoh.errors import NodeError
from vla_zenoh.lab.cli.demo_stage import Stage, latencies, open_stage, print_end
from vla_zenoh.lab.cli.options import DemoOptions
from vla_zenoh.lab.cli.output import print_json
from vla_zenoh.lab.demo.scripted_motions import GRIPPER_AXIS, ScriptedPrompt, parse_scripted
from vla_zenoh.lab.episode import EpisodeRunner
from vla_zenoh.lab.evaluation.result import PromptSegment
from vla_zenoh.lab.evaluation.tables import SEGMENT_COLUMNS, segment_rows
from vla_zenoh.lab.newest_records import NewestRecords
from vla_zenoh.lab.recording.run import Run
from vla_zenoh.types import GripperState, PoseState

STEPS = 50
"""Where neither the prompt nor ``--seconds`` says how many."""
SETTLE_S = 0.8
"""From the end of the commanded motion until arm and integral action are at rest."""
SLACK_S = 15.0
EXACT_M, EXACT_RAD = 0.002, 0.005
"""A fixed motion that is off by more was not done: distance, angle, drift and a gripper's width."""


def run_demo(prompt: str, profile: str, given: DemoOptions) -> None:
    """Run a fixed motion and show how far it came; `SpecError`: the prompt names none."""
    parsed = parse_scripted(prompt)
    steps = parsed.steps or STEPS
    if given.seconds is not None:
        steps = max(round(given.seconds * given.rate_hz), 1)
    asked = parsed._replace(steps=steps).text
    with open_stage(profile, given) as stage:
        stage.profile.require_one_arm("fixed motions of demo")
        done = _carry_out(stage, asked, steps, given.rate_hz)
        if stage.stop.is_set():
            raise typer.Exit(130)
        run = stage.recorded()
        _write_chunks(stage, run)
        (found,) = stage.draw(run)
        segment = next(each for each in found.segments if each.prompt == asked)
        found.segments = [replace(segment, requests=done)]  # not those after its end
        width_m = stage.profile.robot.max_width_m
        faults = faults_of(segment, parse_scripted(asked), width_m)
        if done != steps:
            faults.append(f"{done} of {steps} steps were executed")
        summary = {
            "ok": not faults,
            "faults": faults,
            "profile": stage.profile.name,
            "rate_hz": given.rate_hz,
            "segment": asdict(found.segments[0]),
            "latency_ms": latencies(run),
            "refusals": stage.refusals(),
        }
        stage.write(summary)
    if given.as_json:
        print_json({**summary, "folder": stage.path})
    else:
        screen, table = console(), new_table(*SEGMENT_COLUMNS, left=("prompt",))
        for row in segment_rows(found):
            table.add_row(*row)
        screen.print(table)
        print_end(stage, summary, "chunks.npz")
        for fault in faults:
            screen.print(fault, style="bold red")
        if not faults:
            screen.print("the arm did what was asked", style="bold green")
    if faults:
        raise typer.Exit(1)


def faults_of(segment: PromptSegment, asked: ScriptedPrompt, max_width_m: float) -> list[str]:
    """What a motion is off by, beyond the tolerances; empty: the arm did what was asked."""
    off = [
        ("distance", (segment.asked_m or 0.0) - (segment.along_m or 0.0), EXACT_M, "m"),
        ("angle", (segment.asked_rad or 0.0) - (segment.along_rad or 0.0), EXACT_RAD, "rad"),
        ("drift", segment.drift_m or 0.0, EXACT_M, "m"),
        ("rotation drift", segment.drift_rad or 0.0, EXACT_RAD, "rad"),
    ]
    if segment.width_m is not None and asked.motion is not None:
        before_m, after_m = segment.width_m
        wanted_m = before_m
        for index in range((asked.steps or 0) * (asked.motion.axis == GRIPPER_AXIS)):
            wanted_m = min(max(wanted_m + asked.step(index), 0.0), max_width_m)
        off.append(("gripper", after_m - wanted_m, EXACT_M, "m"))
    return [
        f"{name} off by {abs(value):.4g} {unit} (allowed {limit:g})"
        for name, value, limit, unit in off
        if not abs(value) <= limit
    ]


def _carry_out(stage: Stage, prompt: str, steps: int, rate_hz: float) -> int:
    """Publish a prompt, and wait for its end and for rest; returns the accepted steps."""
    done = 0
    with stage.nodes(24) as (running, client, bars):
        run = EpisodeRunner(client, stage.stop, running.poll)
        keys = client.keys
        kinds = {PoseState: keys.state_pose, GripperState: keys.state_gripper}
        streams = NewestRecords(client.session, kinds)
        run.wait_until_ready(stage.profile.task.worker, streams)
        run.start("hold", rate_hz)
        bar = bars.add_task(prompt, total=steps)
        run.prompt(prompt)

        def ended() -> bool:
            nonlocal done
            view = run.view()
            if not view.active:
                raise NodeError(f"the arm is {view.state}: {view.why}")
            done = view.steps
            bars.update(bar, completed=min(done, steps))
            return view.done and not streams.read(GripperState)[1].moving

        patience_s = 2 * steps / rate_hz + SLACK_S
        run.wait(ended, patience_s, f"{prompt!r} did not end in {patience_s:.0f} s")
        run.pause(SETTLE_S)
    return done


def _write_chunks(stage: Stage, run: Run) -> None:
    """Chunk file for ``vla-zenoh worker replay``: spec, steps (N, H, D), length (N,)."""
    worker = stage.profile.task.worker
    obeyed = {cause.chunk_seq for cause, _ in run.first_commands() if cause.worker == worker}
    answers = [
        entry.record
        for entry in run.chunks
        if entry.record.worker == worker and entry.header.seq in obeyed
    ]
    if not answers:
        return
    spec, chunks = run.specs[answers[0].spec_hash], [answer.steps for answer in answers]
    steps = np.zeros((len(chunks), spec.action.horizon, spec.action.dimension), np.float32)
    for index, chunk in enumerate(chunks):
        steps[index, : len(chunk)] = chunk
    length = np.array([len(chunk) for chunk in chunks], np.int32)
    file = stage.folder / "chunks.npz"
    np.savez_compressed(file, spec=json.dumps(spec.to_dict()), steps=steps, length=length)
