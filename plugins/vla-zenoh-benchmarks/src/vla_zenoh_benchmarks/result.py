"""Result of a benchmark run: success rates with their intervals, as JSON, and as one HTML page."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.lab.durable import page_template
from vla_zenoh.lab.video import VideoWriter
from vla_zenoh_benchmarks.episode import EpisodeOutcome, EpisodeRequest
from vla_zenoh_benchmarks.journal import actions_file
from vla_zenoh_benchmarks.process import FRAME_HZ, BenchmarkProcess
from vla_zenoh_benchmarks.statistics import wilson_95

TEMPLATE = "page.html.j2"
VIDEOS = "failures"


def summary(plan: Mapping[str, Any], ended: Collection[EpisodeOutcome]) -> dict[str, Any]:
    """The result file's content."""
    tasks = list(dict.fromkeys(each.task for each in ended))
    return {
        **plan,
        "delay_ms": plan["delay_ms"] or 0.0,
        "wall_s": round(sum(each.wall_s for each in ended), 3),
        "begun_again": sum(each.attempts - 1 for each in ended),
        **_rates(ended),
        "by_task": {name: _rates([e for e in ended if e.task == name]) for name in tasks},
        "all": [each.to_dict() for each in ended],
    }


def _rates(ended: Collection[EpisodeOutcome]) -> dict[str, Any]:
    done = [each for each in ended if each.success]
    steps, asked = [each.steps for each in done], [each.ask_ms[0] for each in ended]
    return {
        "episodes": len(ended),
        "successes": len(done),
        "success_rate": len(done) / len(ended) if ended else 0.0,
        "wilson_95": list(wilson_95(len(done), len(ended))),
        "steps_to_success_p50": float(np.median(steps)) if steps else None,
        "ask_ms_p50": round(float(np.median(asked)), 3) if asked else 0.0,
        "failures": dict(Counter(each.failure for each in ended if not each.success)),
    }


def write_page(folder: Path, result: Mapping[str, Any]) -> None:
    """Write `index.html` of a run; videos of failures are found in its folder."""
    videos = sorted(each.name for each in (folder / VIDEOS).glob("*.mp4"))
    shown = ("benchmark", "suite", "worker", "options", "mode", "delay_ms", "replan")
    page = page_template("vla_zenoh_benchmarks", TEMPLATE).render(
        title=f"{result['benchmark']} {result['suite']}, {result['worker']}",
        conditions={name: result[name] for name in shown},
        versions=result["versions"],
        result=result,
        rows=[("all", result), *result["by_task"].items()],
        videos=videos,
        folder=VIDEOS,
    )
    (folder / "index.html").write_text(page, "utf-8")


def write_videos(
    folder: Path, place: BenchmarkProcess, failed: Sequence[EpisodeRequest], camera: str, most: int
) -> Iterable[Path]:
    """Videos of failures, drawn from their recorded steps.

    Args:
        place: where the steps are executed again.
        most: largest number; the first failure of every task comes first.
    """
    seen: Counter[str] = Counter()
    order: list[tuple[int, EpisodeRequest]] = []
    for request in failed:
        order.append((seen[request.task.name], request))
        seen[request.task.name] += 1
    for _, request in sorted(order, key=lambda each: each[0])[:most]:
        file = folder / VIDEOS / f"{request.key.replace('/', '.')}.mp4"
        if file.exists():
            continue
        with tempfile.TemporaryDirectory(prefix="vla-zenoh-") as pictures:
            steps = np.load(actions_file(folder, request))
            place.replay(request, steps, camera, Path(pictures))
            part = file.with_suffix(".part.mp4")
            video = VideoWriter(part, FRAME_HZ)
            for jpeg in sorted(Path(pictures).glob("*.jpg")):
                video.add(decode_jpeg(jpeg.read_bytes()).rgb)
            video.close()
            part.rename(file)
        yield file
