"""vla-zenoh dataset: recorded runs as training data."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import JsonOption, not_empty, options
from vla_zenoh.cli.output import console, fail
from vla_zenoh.cli.plain import warn
from vla_zenoh.errors import RecordingError, counted, nearest
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh.lab.cli.output_path import ForceOption, output_file, output_folder
from vla_zenoh.lab.evaluation.evaluate import MCAP, recordings
from vla_zenoh_dataset.episodes import RecordedEpisode
from vla_zenoh_dataset.label import EpisodeLabel


@options
def export(
    runs: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or folders of them.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder for the dataset.")],
    worker: Annotated[
        str | None, typer.Option("--worker", help="Only episodes of this worker.")
    ] = None,
    cameras: Annotated[
        list[str] | None,
        typer.Option("--camera", help="Only this camera; repeatable. Default: all recorded ones."),
    ] = None,
    images: Annotated[bool, typer.Option(help="Images of cameras.")] = True,
    depth: Annotated[
        bool,
        typer.Option(
            help="Depth images of these cameras, where they were recorded, as LeRobot 0.6 has them."
        ),
    ] = True,
    state: Annotated[
        str | None,
        typer.Option(
            "--state",
            help="Parts of the state, as in the worker lerobot. Default: position+rpy+gripper_m; "
            "for actions of joints joint+gripper_m.",
        ),
    ] = None,
    rotation: Annotated[
        bool,
        typer.Option(
            help="Numbers of rotations in the actions. --no-rotation: of a hand that never turns; "
            "numbers that never change cannot be scaled."
        ),
    ] = True,
    labels: Annotated[
        list[EpisodeLabel] | None,
        typer.Option(
            "--label",
            help="Only episodes with this label; repeatable. Default: all but discarded ones.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Export a LeRobotDataset v3.0 with one episode per activation of a worker.

    Where a person took the arm from a model and gave it back that is one episode of the model; the
    column `intervention` says which frames the person led.
    """
    from vla_zenoh_policy_servers.state_vector import read_parts

    from vla_zenoh.lab.recording.run import load_run
    from vla_zenoh_dataset.episodes import episodes_of, without_copies
    from vla_zenoh_dataset.features import usual_state
    from vla_zenoh_dataset.lerobot import export as write
    from vla_zenoh_dataset.success import succeeded, verdict_of_person

    parts, files = read_parts(state) if state else None, list(recordings(runs))
    if not files:
        raise RecordingError(f"no {MCAP} file in {', '.join(map(str, runs))}")
    wanted = labels or [each for each in EpisodeLabel if each is not EpisodeLabel.DISCARDED]
    episodes, workers = list[RecordedEpisode](), set[str]()
    with (
        output_folder(output, force=force, inputs=files) as part,
        progress("reading the recordings") as status,
    ):
        for number, path in enumerate(files, 1):
            status.update(f"reading {path.name} ({number} of {len(files)})")
            run = load_run(path)
            for problem in run.problems:
                warn(f"{path.name}: {problem}")
            workers |= {heard.record.worker for heard in run.chunks}
            found = episodes_of(run, worker)
            for episode in found:
                episode.success = succeeded(episode)
                episode.discarded = verdict_of_person(episode) == "void"
            episodes += found
        if worker is not None and worker not in workers:
            known = ", ".join(sorted(workers)) or "none"
            fail(
                f"no episode of worker {worker!r} is in the recordings{nearest(worker, workers)} "
                f"Workers there: {known}"
            )
        episodes, copies = without_copies(episodes)
        left_out = Counter(each.label for each in episodes if each.label not in wanted)
        episodes = [each for each in episodes if each.label in wanted]
        if left_out and not episodes:
            those = ", ".join(f"{count} {label}" for label, count in left_out.items())
            fail(
                f"no episode has the label {' or '.join(wanted)}; there are: {those}. Choose "
                "another --label"
            )
        runs_used = list({id(each.run): each.run for each in episodes}.values())
        pictures = {str(run.path): set(run.picture_counts) for run in runs_used}
        wanted_cameras = (cameras or in_all(pictures, "images")) if images else []
        depths = {str(run.path): run.depth_cameras & {*wanted_cameras} for run in runs_used}
        written = write(
            part,
            episodes,
            wanted_cameras,
            parts or read_parts(usual_state(episodes)),
            lambda doing: status.update(f"writing {doing} ({counted(len(episodes), 'episode')})"),
            in_all(depths, "depth images") if depth else [],
            rotation=rotation,
        )
    written = written._replace(folder=output, left_out=(*copies, *written.left_out))
    for gap in written.left_out:
        warn(f"left out: {gap}")
    if as_json:
        print_json(written._asdict())
        return
    known = ", ".join(f"{count} {label}" for label, count in written.labels.items())
    console().print(
        f"{written.folder}: {written.episodes} episodes ({known}), {written.frames} frames at "
        f"{written.fps} Hz, {written.interventions} of them led by a person, "
        f"cameras {', '.join(written.cameras) or 'none'}, "
        f"depth {', '.join(written.depth) or 'none'}, "
        f"{counted(len(written.tasks), 'prompt')}"
    )


def in_all(cameras: Mapping[str, Set[str]], what: str) -> list[str]:
    """Cameras that every recording has; warns of those that only some of them have.

    Args:
        cameras: name of a recording -> its cameras.
        what: kind of their images.
    """
    names = sorted(set[str]().union(*cameras.values()))
    lacking = {name: [run for run, found in cameras.items() if name not in found] for name in names}
    for name, runs in lacking.items():
        if runs:
            warn(
                f"camera {name} is left out: {len(runs)} of {counted(len(cameras), 'recording')} "
                f"have no {what} of it ({', '.join(runs[:3])}{', ...' if len(runs) > 3 else ''}); "
                "leave those recordings out to keep it"
            )
    return [name for name in names if not lacking[name]]


@options
def stats(
    folder: Annotated[Path, typer.Argument(help="A LeRobot dataset v3.0.")],
    name: Annotated[
        str | None,
        typer.Option(
            "--name", parser=not_empty, help="Key of the statistics; default: the folder's name."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File; default: dataset_statistics.json in FOLDER."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write OpenVLA's dataset_statistics.json for a dataset."""
    from vla_zenoh_dataset.openvla import openvla_statistics

    path = output or folder / "dataset_statistics.json"
    inputs = (*folder.glob("meta/*.json"), *folder.rglob("*.parquet"))
    with output_file(path, force=force, inputs=inputs) as part:
        content = openvla_statistics(folder, name or folder.resolve().name)
        part.write_text(json.dumps(content, indent=2) + "\n", "utf-8")
    if as_json:
        print_json(content)
    else:
        console().print(f"{path}: key {next(iter(content))!r}")
