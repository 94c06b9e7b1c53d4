"""Judges of unattended episodes: true poses, a user's Python function, or a model's answer."""

from __future__ import annotations

import base64
import json
import runpy
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import decode_jpeg
from vla_zenoh.errors import NodeError, in_words
from vla_zenoh.types import GripperState, PoseState
from vla_zenoh_nights.plan import JudgeChoice

MODEL_PATIENCE_S = 120.0
MAX_ANSWER_BYTES = 1_000_000
MAX_FRAMES = 6
MAX_NOTE = 300


class Frame(NamedTuple):
    """Pictures at one time of an episode. `jpegs`: camera -> JPEG."""

    time_s: float
    jpegs: Mapping[str, bytes]


class StateSample(NamedTuple):
    """Measured state at one time of an episode, poses of the TCP. `gripper`: None: unknown."""

    time_s: float
    pose: PoseState
    gripper: GripperState | None


@dataclass(slots=True)
class JudgedEpisode:
    """What a judge sees of an episode.

    Args:
        end: ``policy`` or ``time``, as in `vla_zenoh_trial.verdict`.
        frames: oldest first, about one each second; the last is from after the brake.
        states: oldest first, about 20 each second.
    """

    prompt: str
    end: str = ""
    frames: list[Frame] = field(default_factory=list)
    states: list[StateSample] = field(default_factory=list)

    def picture(self, camera: str, index: int = -1) -> NDArray[np.uint8]:
        """(h, w, 3) RGB of a camera. Raises KeyError: the camera had none then."""
        return decode_jpeg(self.frames[index].jpegs[camera]).rgb

    def chosen(self) -> list[Frame]:
        """`MAX_FRAMES` at most, evenly, with the first and the last."""
        if len(self.frames) <= MAX_FRAMES:
            return list(self.frames)
        return [self.frames[int(i)] for i in np.linspace(0, len(self.frames) - 1, MAX_FRAMES)]


Judge = Callable[[JudgedEpisode], tuple[bool, str]]
"""Success, and a note."""


def make_judge(choice: JudgeChoice, folder: Path) -> Judge | None:
    """The judge of finished episodes; None: the simulator's, which judges while the arm moves.

    Raises:
        NodeError: the file has no such function.
    """
    if choice.file:
        return _python_judge(folder / choice.file)
    return _model_judge(choice) if choice.url else None


def _python_judge(path: Path) -> Judge:
    try:
        function = runpy.run_path(str(path)).get("judge")
    except Exception as error:
        raise NodeError(f"judge {path}: {in_words(error)}") from error
    if not callable(function):
        raise NodeError(f"judge {path}: define judge(episode), which returns True or False")

    def judge(episode: JudgedEpisode) -> tuple[bool, str]:
        try:
            answer: Any = function(episode)
            success, note = answer if isinstance(answer, tuple) else (answer, "")
        except Exception as error:
            raise NodeError(f"judge {path}: {in_words(error)}") from error
        if not isinstance(success, (bool, np.bool_)):
            raise NodeError(f"judge {path} returned {success!r}; allowed: True, False")
        return bool(success), _line(str(note))

    return judge


def _model_judge(choice: JudgeChoice) -> Judge:
    def judge(episode: JudgedEpisode) -> tuple[bool, str]:
        content: list[dict[str, Any]] = [
            {"type": "text", "text": choice.question.replace("{prompt}", episode.prompt)}
        ]
        for frame in episode.chosen():
            for jpeg in frame.jpegs.values():
                url = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
                content.append({"type": "image_url", "image_url": {"url": url}})
        body = {
            "model": choice.model,
            "temperature": 0,
            "messages": [{"role": "user", "content": content}],
        }
        try:
            found = json.loads(post_json(choice.url, body, MODEL_PATIENCE_S, MAX_ANSWER_BYTES))
            answer = str(found["choices"][0]["message"]["content"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise NodeError(f"judge {choice.url}: {in_words(error)}") from error
        word = answer.strip().lower()
        if not word.startswith(("yes", "no")):
            raise NodeError(f"judge {choice.url}: the answer begins with neither yes nor no")
        return word.startswith("yes"), _line(answer)

    return judge


def post_json(url: str, body: Mapping[str, Any], timeout_s: float, most: int = 0) -> bytes:
    """Post an object; the first `most` bytes of the answer. Raises OSError, ValueError."""
    content = json.dumps(body).encode()
    request = urllib.request.Request(url, content, {"content-type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as response:
            return response.read(most)
    except urllib.error.HTTPError as error:
        error.close()
        raise


def _line(text: str) -> str:
    return " ".join(text.split())[:MAX_NOTE]
