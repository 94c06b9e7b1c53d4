"""Writes a LeRobotDataset in format v3.0, parquet, MP4 and JSON, without LeRobot.

    data/chunk-000/file-000.parquet                     frames, one row group an episode
    videos/<camera key>/chunk-000/file-000.mp4          one file an episode
    meta/info.json stats.json tasks.parquet episodes/chunk-000/file-000.parquet

In addition ``meta/vla_zenoh.json`` holds the spec and the source of each episode.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from vla_zenoh_policy_servers.state_vector import StateNumbers

from vla_zenoh.errors import RecordingError
from vla_zenoh.lab.recording.run import Run
from vla_zenoh.lab.video import CODEC, PIXEL_FORMAT
from vla_zenoh.policy import ActionSpec
from vla_zenoh_dataset.episodes import EpisodeGap, RecordedEpisode, fps_of
from vla_zenoh_dataset.features import (
    ACTION,
    INTERVENTION,
    PICTURE,
    STATE,
    action_names,
    actions_of,
    check_gripper_widths,
    check_never_turns,
    check_one_robot,
    joined,
    kept_columns,
    names_of_state,
    numbers_of,
    of_numbers,
    states_of,
    to_scale_with,
    worker_options,
)
from vla_zenoh_dataset.videos import (
    DepthColumn,
    EpisodeVideo,
    chosen,
    stamps_of,
    with_images,
    write_videos,
)

VERSION = "v3.0"
FILES_IN_A_CHUNK = 1000
PART = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA, EPISODES = f"data/{PART}.parquet", f"meta/episodes/{PART}.parquet"
VIDEOS, TASKS = f"videos/{{video_key}}/{PART}.mp4", "meta/tasks.parquet"
INFO, STATS, OURS = "meta/info.json", "meta/stats.json", "meta/vla_zenoh.json"
DATA_MB, VIDEO_MB = 100, 200
"""Sizes at which LeRobot starts another file when it appends to a dataset."""
LED = ("since_ns", "until_ns", "worker")
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


class Written(NamedTuple):
    """Result of an export.

    Args:
        successes: number of successful episodes; None if unknown for all.
        left_out: episodes of which something was not recorded, and what.
    """

    folder: Path
    episodes: int
    frames: int
    fps: int
    cameras: tuple[str, ...]
    depth: tuple[str, ...]
    tasks: tuple[str, ...]
    successes: int | None
    interventions: int
    labels: Mapping[str, int]
    left_out: tuple[str, ...]


def export(
    folder: Path,
    episodes: Sequence[RecordedEpisode],
    cameras: Sequence[str],
    parts: Sequence[str],
    progress: Callable[[str], None] = lambda doing: None,
    depth: Sequence[str] = (),
    *,
    rotation: bool = True,
) -> Written:
    """Write a dataset.

    An episode begins with the first frame for which every camera has an image: one that is shown
    nothing newer than a policy could have seen. Episodes in which images or states are missing are
    left out.

    Args:
        folder: must not exist, or be empty.
        parts: of the state, see `vla_zenoh_policy_servers.state_vector`.
        progress: called with what is being written.
        depth: cameras whose depth images to export.
        rotation: False: without the numbers of rotations, which have to be no rotation throughout.

    Raises:
        RecordingError: the folder is not empty; there are no episodes; their actions differ in
            meaning, their robots in joints, or their grippers in width; none was recorded without a
            gap; they turn the hand, and `rotation` is False.
    """
    if not episodes:
        raise RecordingError("the recordings hold no episode: no chunk was executed in them")
    if any(_step(episode) != _step(episodes[0]) for episode in episodes):
        whose = ", ".join(sorted({episode.worker for episode in episodes}))
        raise RecordingError(
            f"the actions of the workers {whose} do not mean the same; choose one with --worker"
        )
    check_one_robot(episodes)
    check_gripper_widths(episodes, parts)
    if not rotation:
        check_never_turns(episodes)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RecordingError(f"{folder} is there already; give --output a new folder")
    kept, gaps = with_images(episodes, cameras, depth)
    # One meaning for all runs, whatever their profiles say of joint order and home.
    numbers = numbers_of(episodes[0], parts)
    whole: dict[int, NDArray[np.float32]] = {}
    for index, episode in enumerate(kept):
        try:
            whole[index] = states_of(episode, numbers)
        except EpisodeGap as gap:
            gaps.append(str(gap))
    if not whole:
        raise RecordingError(
            f"no episode was recorded without a gap: {gaps[0]}. Leave what is missing out with "
            "--camera, --no-images or --state"
        )
    seen = [kept[index] for index in whole], [*whole.values()], numbers
    made = _Dataset(folder, seen, cameras, parts, depth, rotation=rotation)
    return made.write(progress)._replace(left_out=tuple(gaps))


def _step(episode: RecordedEpisode) -> dict[str, ActionSpec]:
    """What a step of an episode means; a policy may plan more of them at once than another."""
    spec = episode.spec
    return {part: spec.action.of(part).model_copy(update={"horizon": 1}) for part in spec.parts}


class _Dataset:
    def __init__(
        self,
        root: Path,
        seen: tuple[list[RecordedEpisode], list[NDArray[np.float32]], dict[str, StateNumbers]],
        cameras: Sequence[str],
        parts: Sequence[str],
        depth: Sequence[str],
        *,
        rotation: bool,
    ) -> None:
        self._root = root
        self._episodes, self._states, self._numbers = seen
        self._cameras, self._parts = tuple(cameras), parts
        self._depths = [DepthColumn(camera) for camera in depth]
        self._spec = self._episodes[0].spec
        self._rotation = rotation
        self._columns = kept_columns(self._spec.action, rotation=rotation)
        self._fps = fps_of(self._spec.action)
        self._state_names = names_of_state(self._numbers, self._spec.action)
        self._tasks = list(
            dict.fromkeys(frame.prompt for episode in self._episodes for frame in episode.frames)
        )

    def write(self, progress: Callable[[str], None]) -> Written:
        videos: dict[str, list[EpisodeVideo]] = {}
        for camera in self._cameras:
            progress(f"videos of camera {camera}")
            videos[camera] = self._write_videos(camera)
        progress("depth images and numbers" if self._depths else "numbers of all frames")
        rows = self._write_data()
        self._write_tasks()
        self._write_episodes(rows, videos)
        self._write_json(rows, videos)
        known = [episode.success for episode in self._episodes if episode.success is not None]
        return Written(
            self._root,
            len(self._episodes),
            sum(len(each["index"]) for each in rows),
            self._fps,
            self._cameras,
            tuple(column.camera for column in self._depths),
            tuple(self._tasks),
            sum(known) if known else None,
            sum(int(each[INTERVENTION].sum()) for each in rows),
            dict(Counter(episode.label.value for episode in self._episodes)),
            (),
        )

    def _place(self, pattern: str, number: int, **more: str) -> Path:
        chunk_index, file_index = divmod(number, FILES_IN_A_CHUNK)
        path = self._root / pattern.format(chunk_index=chunk_index, file_index=file_index, **more)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _write_videos(self, camera: str) -> list[EpisodeVideo]:
        """The video of each episode, in their order; each run is read twice."""
        out: dict[int, EpisodeVideo] = {}
        runs = {id(episode.run): episode.run for episode in self._episodes}
        for run in runs.values():
            stamps = stamps_of(run, camera)
            mine = [at for at, episode in enumerate(self._episodes) if episode.run is run]
            found = [chosen(self._episodes[at], camera, stamps) for at in mine]
            wanted = [
                (self._place(VIDEOS, at, video_key=PICTURE + camera), pictures)
                for at, pictures in zip(mine, found, strict=True)
            ]
            out.update(zip(mine, write_videos(run, camera, wanted, self._fps), strict=True))
        sizes = {video.video.size for video in out.values()}
        if len(sizes) > 1:
            raise RecordingError(f"camera {camera!r} has pictures of {len(sizes)} sizes: {sizes}")
        return [out[at] for at in range(len(self._episodes))]

    def _write_data(self) -> list[dict[str, NDArray[Any]]]:
        """Write the frames; returns the rows of each episode."""
        numbers = {STATE: len(self._state_names), ACTION: len(self._columns)}
        schema = pa.schema(
            [(name, pa.list_(pa.float32(), size)) for name, size in numbers.items()]
            + [(INTERVENTION, pa.bool_()), ("timestamp", pa.float32())]
            + [(name, pa.int64()) for name in COUNTERS[1:]]
        )
        file = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        for depth in self._depths:
            schema = schema.append(pa.field(depth.name, file))
        out, first = [], 0
        with pq.ParquetWriter(self._place(DATA, 0), schema) as writer:
            for number, (episode, states) in enumerate(
                zip(self._episodes, self._states, strict=True)
            ):
                count = len(episode.frames)
                tasks = [self._tasks.index(frame.prompt) for frame in episode.frames]
                rows: dict[str, NDArray[Any]] = {
                    STATE: states,
                    ACTION: np.ascontiguousarray(actions_of(episode)[:, self._columns]),
                    INTERVENTION: np.array([frame.intervention for frame in episode.frames]),
                    "timestamp": (np.arange(count) / self._fps).astype(np.float32),
                    "frame_index": np.arange(count),
                    "episode_index": np.full(count, number),
                    "index": np.arange(first, first + count),
                    "task_index": np.array(tasks),
                }
                columns = [
                    pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
                    if values.ndim == 2
                    else pa.array(values, schema.field(name).type)
                    for name, values in rows.items()
                ]
                columns += [pa.array(depth.files(episode), file) for depth in self._depths]
                table = pa.Table.from_arrays(columns, names=schema.names).cast(schema)
                writer.write_table(table)  # a row group of its own
                out.append(rows)
                first += count
        return out

    def _write_tasks(self) -> None:
        table = pa.table({"task_index": range(len(self._tasks)), "task": self._tasks})
        # LeRobot reads it with pandas and takes the tasks from the index.
        kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        columns = [
            {
                "name": name,
                "field_name": name,
                "pandas_type": kind,
                "numpy_type": dtype,
                "metadata": None,
            }
            for name, kind, dtype in kinds
        ]
        pandas = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": columns,
            "pandas_version": "2.2.0",
        }
        table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
        pq.write_table(table, self._place(TASKS, 0))

    def _write_episodes(
        self, rows: list[dict[str, NDArray[Any]]], videos: dict[str, list[EpisodeVideo]]
    ) -> None:
        table: dict[str, list[Any]] = {}
        for number, (episode, mine) in enumerate(zip(self._episodes, rows, strict=True)):
            count, first = len(mine["index"]), int(mine["index"][0])
            entry: dict[str, Any] = {
                "episode_index": number,
                "tasks": list(dict.fromkeys(frame.prompt for frame in episode.frames)),
                "length": count,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": first,
                "dataset_to_index": first + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "success": episode.success,
                "label": episode.label.value,
                "worker": episode.worker,
                "run": episode.run.path.name,
            }
            found = {name: of_numbers(values) for name, values in mine.items()}
            chunk, file = divmod(number, FILES_IN_A_CHUNK)
            for camera, of_episodes in videos.items():
                name = PICTURE + camera
                entry |= {
                    f"videos/{name}/chunk_index": chunk,
                    f"videos/{name}/file_index": file,
                    f"videos/{name}/from_timestamp": 0.0,
                    f"videos/{name}/to_timestamp": count / self._fps,
                }
                found[name] = of_episodes[number].histogram.statistics()
            for depth in self._depths:
                found[depth.name] = depth.histograms[number].statistics()
            for name, values in found.items():
                entry |= {f"stats/{name}/{what}": value for what, value in values.items()}
            for name, value in entry.items():
                table.setdefault(name, []).append(value)
        success = pa.array(table.pop("success"), pa.bool_())
        made = pa.table(table).append_column("success", success)
        pq.write_table(made, self._place(EPISODES, 0))

    def _write_json(
        self, rows: list[dict[str, NDArray[Any]]], videos: dict[str, list[EpisodeVideo]]
    ) -> None:
        stats = {
            name: of_numbers(np.concatenate([each[name] for each in rows])) for name in rows[0]
        }
        stats |= {name: to_scale_with(stats[name]) for name in (STATE, ACTION)}
        for camera, of_episodes in videos.items():
            stats[PICTURE + camera] = joined([video.histogram for video in of_episodes])
        for depth in self._depths:
            stats[depth.name] = joined(depth.histograms)
        info = {
            "codebase_version": VERSION,
            "robot_type": self._episodes[0].run.keys.robot,
            "total_episodes": len(rows),
            "total_frames": sum(len(each["index"]) for each in rows),
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_IN_A_CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": DATA,
            "video_path": VIDEOS if videos else None,
            "features": self._features(videos),
        }
        ours = {
            "spec": self._spec.to_dict(),
            "state": "+".join(self._parts),
            "options": self._options(),
            "rotation_reference": self._references(),
            "episodes": [
                {
                    "run": episode.run.path.name,
                    "worker": episode.worker,
                    "since_ns": episode.since_ns,
                    "until_ns": episode.until_ns,
                    "success": episode.success,
                    "label": episode.label.value,
                    "led": [dict(zip(LED, span, strict=True)) for span in episode.led],
                    "cameras": {name: _camera_of(episode.run, name) for name in self._cameras},
                }
                for episode in self._episodes
            ],
        }
        for path, content in ((INFO, info), (STATS, stats), (OURS, ours)):
            (self._root / path).write_text(json.dumps(content, indent=2) + "\n", "utf-8")

    def _references(self) -> dict[str, list[float]]:
        """Part of the robot -> x, y, z, w that signs and cuts of its rotations are nearest to."""
        return {part: [*own.reference] for part, own in self._numbers.items()}

    def _options(self) -> dict[str, str] | None:
        """Of the worker ``lerobot`` for a policy of this dataset; None: its arms have others."""
        action, parts = self._spec.action, self._spec.parts
        run = self._episodes[0].run
        each = [worker_options(action.of(part), run.of_part(part).profile) for part in parts]
        options = each[0]
        if any(other != options for other in each):
            return None
        if not self._rotation and action.of(parts[0]).space == "tcp":
            options["rotation"] = "none"
        return {**options, "state": "+".join(self._parts), "parts": ",".join(filter(None, parts))}

    def _features(self, videos: dict[str, list[EpisodeVideo]]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for camera, of_episodes in videos.items():
            height, width = of_episodes[0].video.size
            out[PICTURE + camera] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": height,
                    "video.width": width,
                    "video.codec": CODEC.replace("libx264", "h264"),
                    "video.pix_fmt": PIXEL_FORMAT,
                    "video.fps": self._fps,
                    "video.channels": 3,
                    "is_depth_map": False,
                    "has_audio": False,
                },
            }
        out |= {depth.name: depth.feature() for depth in self._depths}
        every = action_names(self._spec.action)
        actions = [every[column] for column in self._columns]
        for name, names in ((STATE, self._state_names), (ACTION, actions)):
            out[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
        for name in (INTERVENTION, *COUNTERS):
            dtype = {INTERVENTION: "bool", "timestamp": "float32"}.get(name, "int64")
            out[name] = {"dtype": dtype, "shape": [1], "names": None}
        return out


def _camera_of(run: Run, name: str) -> dict[str, Any]:
    """Mount of a camera by the recorded profile, and its lens by its node; None: unknown."""
    camera = run.profile.cameras.get(name)
    mount = None if camera is None else camera.mount
    found = None
    for status in run.statuses.values():
        cameras = status.detail.get("cameras")
        about = cameras.get(name) if isinstance(cameras, Mapping) else None
        if isinstance(about, Mapping):
            found = about.get("intrinsics", found)
    return {"mount": None if mount is None else mount.model_dump(mode="json"), "intrinsics": found}
