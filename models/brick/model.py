# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "onnxruntime>=1.20"]
# ///
"""Puts, stacks and pushes bricks by prompt: a small policy, trained in the scene ``bricks``.

Input are two images, the hand and the prompt; output are waypoints of the hand relative to its
measured pose. Motion that was requested before and is not reached yet is subtracted, because a
delta is added to the goal in force when the observation was taken. See README.md beside this file.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import WorkerError, in_words
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.policy.inference import Committed
from vla_zenoh.policy.options import one_of
from vla_zenoh.types import PoseState, Task

FloatArray = NDArray[np.float64]

FOLDER = Path(__file__).parent
GRAPH, WORDS, MANIFEST = "brick.onnx", "words.txt", "weights.json"
HORIZON, DT_S = 8, 0.1
FRONT, WRIST = (128, 96), (96, 72)
"""Width and height of the images."""
STEP_M, STEP_RAD = 0.045, 0.18
"""A waypoint further from the one before is approached in several steps."""
WIDTH_STEP_M = 0.08
MOVED = [0, 1, 2, 5]
"""Columns of a step that move the hand: along x, y, z and about the vertical."""
LOW_M, UP_M, PUSH_WAY_M = 0.035, 0.05, 0.105
"""See `expert`."""
AT_REST_M_S = 0.004
MAX_PIECES, MAX_LETTERS = 32, 400
PAD, UNKNOWN = 0, 1
KINDS = ("put", "stack", "left", "right", "away", "closer")
COLOURS = ("red", "blue", "green", "yellow")
SURE = 0.9
NEGATION = re.compile(
    r"\b(no|not|nto|nor|never|none|nobody|nothing|neither|without|cannot|instead)\b"
    r"|\b(do|does|did|ca|could|wo|would|sha|should|must|need|is|are|was|were|have|has|had|may)"
    r"\s?n\s?['\u2019`]?t\b"
)
"""Words that turn a task into something else. If the network misread one of these, an arm that was
told to stay would move, so it is not asked."""
"""A prompt with less probability of being a task is none."""


class Waypoints(NamedTuple):
    """Waypoints, relative to the measured hand.

    Args:
        offset: (H, 4) x, y, z in m along the base axes and a turn about the vertical in rad.
        opened: (H,) the gripper must be open.
        understood: the prompt is a task; else the arm stays.
        order: the parsed prompt: ``put red``, ``stack red blue``, ``left red``.
    """

    offset: FloatArray
    opened: NDArray[np.bool_]
    understood: bool
    order: str


@dataclass(slots=True)
class Hand:
    """The TCP, and its history in an episode.

    Args:
        position_m: (3,) measured.
        yaw_rad: measured turn about the vertical.
        width_m: measured opening.
        swept_m: see `expert.Hand`.
        down_m: (2,) where it came down below `LOW_M`; None while it is above.
    """

    position_m: FloatArray
    yaw_rad: float
    width_m: float
    swept_m: float = 0.0
    down_m: FloatArray | None = None

    @property
    def start(self) -> FloatArray:
        """(4,) x, y, z in m and the turn in rad."""
        return np.append(self.position_m, self.yaw_rad)

    def numbers(self) -> FloatArray:
        """(9,) the network's input for it."""
        x, y, z = self.position_m
        return np.array(
            [
                (x - 0.48) / 0.15,
                y / 0.25,
                (z - 0.1) / 0.08,
                math.log(max(z, 0.008) / 0.05),
                math.sin(self.yaw_rad),
                math.cos(self.yaw_rad),
                (self.width_m - 0.04) / 0.04,
                min(self.swept_m, 0.15) / 0.05,
                float(self.down_m is not None),
            ]
        )


class Question(NamedTuple):
    """What the network is asked for one robot.

    Args:
        observation: now.
        hand: now.
        given: (H, 6) waypoints that can no longer change, as in `Waypoints`, relative to the hand:
            the offset, 1 for open, and 1 for a row that is given.
    """

    observation: Observation
    hand: Hand
    given: FloatArray


@dataclass(slots=True)
class Memory:
    """What is remembered of a robot in an episode.

    Args:
        hand: at its last observation.
        prompt: of that.
        asked: (H + 1, 4) the goal from which its last chunk began, and those it requested.
    """

    hand: Hand | None = None
    prompt: str = ""
    asked: FloatArray | None = None


def words_of(prompt: str) -> list[str]:
    """The prompt as words, numbers and punctuation, in lower case without accents."""
    plain = unicodedata.normalize("NFKD", prompt.lower())
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter))
    return re.findall(r"[a-z]+|[0-9]+|[^a-z0-9\s]", plain)


def forbids(prompt: str) -> bool:
    """Whether there is a negation anywhere in a prompt."""
    return NEGATION.search(prompt.lower()) is not None


def tokens_of(prompt: str, vocabulary: dict[str, int]) -> NDArray[np.int64]:
    """(1, MAX_PIECES) numbers of the pieces of its words; a prompt that is too long is unknown.

    Args:
        prompt: any text.
        vocabulary: piece -> number; one that does not begin a word begins with ``##``. A word is
            cut into the longest pieces from its beginning (WordPiece: Schuster and Nakajima, 2012).
    """
    numbers: list[int] = []
    for word in words_of(prompt[:MAX_LETTERS]):
        found, begin = [], 0
        while begin < len(word):
            for end in range(len(word), begin, -1):
                number = vocabulary.get("##" * (begin > 0) + word[begin:end])
                if number is not None:
                    break
            else:
                found = [UNKNOWN]
                break
            found.append(number)
            begin = end
        numbers += found
    if not numbers or len(numbers) > MAX_PIECES or len(prompt) > MAX_LETTERS:
        numbers = [UNKNOWN]
    return np.array([numbers + [PAD] * (MAX_PIECES - len(numbers))], np.int64)


class Brick:
    """A small policy for bricks; see the module.

    Args:
        weights: folder with graph and manifest; empty: beside this file.
        threads: of the inference.
        prefix: ``on``: a chunk begins with the steps in execution that can no longer change, and
            continues as the network learned to from such steps.
    """

    def __init__(self, weights: str = "", threads: str = "2", prefix: str = "off") -> None:
        one_of("prefix", prefix, ("on", "off"))
        self.takes_committed = prefix == "on"
        self.spec = ModelSpec(
            name="brick",
            observation=ObservationSpec(
                cameras=(
                    CameraSpec(camera="front", width=FRONT[0], height=FRONT[1], resize="stretch"),
                    CameraSpec(camera="wrist", width=WRIST[0], height=WRIST[1], resize="stretch"),
                ),
                state=("pose", "gripper"),
                prompt=True,
            ),
            action=ActionSpec(
                horizon=HORIZON, dt_s=DT_S, rotation="rotvec", gripper="delta_m", frame="base"
            ),
        )
        self._folder = Path(weights) if weights else FOLDER
        self._threads = int(threads)
        self._session: Any = None
        self._memory: dict[str, Memory] = {}

    def load(self) -> None:
        """Read the weights.

        Raises:
            WorkerError: a file is missing, or not the one in its manifest.
        """
        manifest = read_manifest(self._folder)
        graph = checked(self._folder, GRAPH, manifest["sha256"])
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self._threads
        # Threads that wait for work must not take time from the controller.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(
            graph, options, providers=["CPUExecutionProvider"]
        )
        words = checked(self._folder, WORDS, manifest["sha256"]).decode().split()
        self._vocabulary = {word: index + 2 for index, word in enumerate(words)}

    def reset(self, robot: str = "") -> None:
        """Forget past requests and the hand's history of a robot; empty: of all."""
        if robot:
            self._memory.pop(robot, None)
        else:
            self._memory.clear()

    def infer(self, observation: Observation, committed: Committed | None = None) -> ActionSteps:
        """The next chunk; it begins with the frozen steps, and the network continues from there."""
        return self.infer_batch([observation], [committed])[0]

    def infer_batch(
        self,
        observations: Sequence[Observation],
        committed: Sequence[Committed | None] | None = None,
    ) -> list[ActionSteps]:
        """The next chunk of each robot, by what is remembered of that one."""
        prefixes = [
            np.zeros((0, 7)) if one is None else one.steps[: one.frozen]
            for one in committed or [None] * len(observations)
        ]
        questions: list[Question] = []
        goals: list[FloatArray] = []
        for observation, frozen in zip(observations, prefixes, strict=True):
            memory = self._memory.setdefault(observation.robot, Memory())
            if observation.prompt != memory.prompt:
                # A completed push belongs to the previous task.
                memory.prompt, memory.hand = observation.prompt, None
            hand = memory.hand = follow(observation, memory.hand)
            goal = _goal(observation, hand, memory.asked)
            given = np.zeros((HORIZON, 6), np.float32)
            given[: len(frozen), :4] = goal - hand.start + np.cumsum(frozen[:, MOVED], axis=0)
            given[: len(frozen), 4] = frozen[:, 6] > 0
            given[: len(frozen), 5] = 1.0
            goals.append(goal)
            questions.append(Question(observation, hand, given))
        thought = zip(questions, self.think(questions), goals, prefixes, strict=True)
        return [self._answer(*each) for each in thought]

    def _answer(
        self, question: Question, waypoints: Waypoints, goal: FloatArray, frozen: FloatArray
    ) -> ActionSteps:
        observation, start = question.observation, question.hand.start
        steps = np.zeros((HORIZON, 7))
        if waypoints.understood:
            steps[: len(frozen)] = frozen
            before = goal + frozen[:, MOVED].sum(axis=0)
            for row, (offset, opened) in enumerate(
                zip(waypoints.offset, waypoints.opened, strict=True)
            ):
                if row < len(frozen):
                    continue
                step = start + offset - before
                step[3] = (step[3] + math.pi) % (2 * math.pi) - math.pi
                step[:3] *= min(1.0, STEP_M / max(float(np.linalg.norm(step[:3])), 1e-9))
                step[3] = min(max(step[3], -STEP_RAD), STEP_RAD)
                before = before + step
                steps[row, MOVED] = step
                steps[row, 6] = WIDTH_STEP_M if opened else -WIDTH_STEP_M
        asked = goal + np.cumsum(steps[:, MOVED], axis=0)
        self._memory[observation.robot].asked = np.concatenate([goal[None], asked])
        read = waypoints.order if waypoints.understood else "no task"
        return ActionSteps(steps.astype(np.float32), raw={"read": read})

    def think(self, questions: Sequence[Question]) -> list[Waypoints]:
        """Waypoints of each by the network, whose graph is of one robot."""
        if self._session is None:
            self.load()
        return [self._think(*question) for question in questions]

    def _think(self, observation: Observation, hand: Hand, given: FloatArray) -> Waypoints:
        prompt = observation.prompt
        feed = {
            **{name: observation.images[name][None] for name in ("front", "wrist")},
            "tokens": tokens_of(prompt, self._vocabulary),
            "hand": hand.numbers()[None].astype(np.float32),
            "given": given[None].astype(np.float32),
        }
        outputs = ["offset", "opened", "understood", "order"]
        offset, opened, understood, (order,) = self._session.run(outputs, feed)
        kind, target, onto = KINDS[order[0]], COLOURS[order[1]], COLOURS[order[2]]
        return Waypoints(
            offset[0].astype(np.float64),
            opened[0] > 0.5,
            bool(understood[0] > SURE) and not forbids(prompt),
            f"{kind} {target} {onto}" if kind == "stack" else f"{kind} {target}",
        )

    def read(self, prompt: str) -> str:
        """The task of a prompt, as `Waypoints.order`; empty: no task."""
        nothing = {
            "front": np.zeros((FRONT[1], FRONT[0], 3), np.uint8),
            "wrist": np.zeros((WRIST[1], WRIST[0], 3), np.uint8),
        }
        seen = Observation(0, 0, Task(0, False, prompt, "", 1.0), nothing)
        hand = Hand(np.zeros(3), 0.0, 0.0)
        (found,) = self.think([Question(seen, hand, np.zeros((HORIZON, 6)))])
        return found.order if found.understood else ""


def follow(observation: Observation, last: Hand | None) -> Hand:
    """The hand now, with the history of the one before."""
    pose, gripper = observation.pose, observation.gripper
    assert pose is not None
    assert gripper is not None
    hand = Hand(np.array(pose.position_m), yaw_of(pose), gripper.width_m)
    if last is not None:
        hand.swept_m = last.swept_m
    if hand.position_m[2] < LOW_M:
        down_m = None if last is None else last.down_m
        hand.down_m = hand.position_m[:2] if down_m is None else down_m
        way_m = float(np.linalg.norm(hand.position_m[:2] - hand.down_m))
        hand.swept_m = max(hand.swept_m, way_m)
    elif hand.position_m[2] > UP_M and hand.swept_m < PUSH_WAY_M:
        hand.swept_m = 0.0
    return hand


def _goal(observation: Observation, hand: Hand, goals: FloatArray | None) -> FloatArray:
    """(4,) x, y, z, yaw requested when the observation was taken; `goals`: `Memory.asked`."""
    pose = observation.pose
    assert pose is not None
    here = hand.start
    if pose.reference_position_m is not None:
        here[:3] = pose.reference_position_m
    # Parts that the command node cut off are not known here; an arm at rest shows them.
    at_rest = bool(np.linalg.norm(pose.twist[:3]) < AT_REST_M_S)
    done = observation.executed_steps
    if goals is None or done is None:
        return here
    row = min(int(done), HORIZON - 1)
    share = done - row if done < HORIZON else 1.0
    asked = goals[row] + share * (goals[row + 1] - goals[row])
    if at_rest and done > 1.0 and np.linalg.norm(np.ptp(goals[1 : row + 2, :3], axis=0)) < 1e-3:
        return np.append(here[:3], asked[3])
    return asked


def yaw_of(pose: PoseState) -> float:
    """Turn about the vertical; 0 where the tool's x axis points along the base's."""
    x, y, z, w = pose.quat_xyzw.tolist()
    return math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of the weights: the sha256 of each file.

    Raises:
        WorkerError: it is missing, or not readable.
    """
    path = folder / MANIFEST
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise WorkerError(
            f"{path} cannot be read: {in_words(error)}; train and export a policy"
        ) from error


def checked(folder: Path, name: str, sha256: dict[str, str]) -> bytes:
    """The file's content, if it matches the manifest.

    Raises:
        WorkerError: it is missing, or its sha256 differs.
    """
    path = folder / name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise WorkerError(f"{path} cannot be read: {in_words(error)}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256.get(name):
        raise WorkerError(
            f"{path} has sha256 {found}, {MANIFEST} says {sha256.get(name)}: the file was changed "
            "or is not whole; take both from one export"
        )
    return content


MODEL = Brick
