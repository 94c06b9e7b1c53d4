# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""A small worker that keeps its contract, or breaks it in one of many ways.

``vla-zenoh check tests/contract/broken_worker.py --set fault=millimetres``
"""

from __future__ import annotations

import math
import time
import zlib
from typing import Any

import numpy as np

from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)

STEP_M, STEP_RAD = 0.01, 0.05
CAMERA = CameraSpec(camera="front", width=32, height=24, resize="stretch")


async def later(steps: np.ndarray) -> ActionSteps:
    return ActionSteps(steps)


class Tensor:
    """As PyTorch's of a network that is trained."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("requires grad. Use tensor.detach().numpy() instead")


class Worker:
    """Goes where the pictures and the prompt say, in a way of its own.

    Args:
        fault: what it does wrong, empty for nothing.
    """

    def __init__(self, fault: str = "") -> None:
        self.fault = fault
        action: dict[str, Any] = {"horizon": 4, "dt_s": 0.1, "gripper": "open_fraction"}
        camera = CAMERA
        if fault in ("norm", "order"):
            action["rotation"] = "quaternion"
        if fault == "late":
            action |= {"dt_s": 0.001}
        if fault == "camera":
            camera = CameraSpec(camera="ceiling")
        if fault == "size":
            camera = CameraSpec(camera="front", width=32, height=24)
        if fault == "key":
            action["normalisation"] = "bridge"
            self.normalisation_keys = ("libero_spatial", "libero_goal")
        self.spec = ModelSpec(
            name="broken",
            observation=ObservationSpec(cameras=(camera,)),
            action=ActionSpec(**action),
        )
        if fault in ("mixed", "lost"):
            self.infer_batch = self._infer_batch
        self._kept: list[Observation] = []
        self._noise = np.random.default_rng(0)

    def load(self) -> None:
        if self.fault == "load":
            raise FileNotFoundError("weights.safetensors")
        if self.fault == "spec":
            action = self.spec.action.model_copy(update={"gripper_open_is_high": False})
            self.spec = self.spec.model_copy(update={"action": action})

    def reset(self) -> None:
        if self.fault == "reset":
            raise KeyError("episode")

    def infer(self, observation: Observation) -> ActionSteps:
        fault, horizon = self.fault, self.spec.action.horizon
        (picture,) = observation.images.values()
        if fault == "raises":
            raise RuntimeError("device-side assert")
        if fault == "writes":
            picture[0, 0] = 0
        if fault == "prompt" and not observation.prompt.isascii():
            raise UnicodeEncodeError("ascii", observation.prompt, 0, 1, "not in range")
        if fault == "grows":
            self._kept.append(observation)
            self._kept.append(np.ones(60_000))  # pyright: ignore[reportArgumentType]
        if fault in ("slow", "late", "hangs"):
            time.sleep({"slow": 1.2, "late": 0.01, "hangs": 60.0}[fault])
        steps = np.zeros((horizon, self.spec.action.dimension), np.float32)
        steps[:, :3] = STEP_M * np.tanh(self._seen(picture) - 0.3)
        steps[:, 3] = STEP_RAD * self._asked(observation.prompt)
        steps[:, -1] = 1.0
        if fault == "random":
            steps[:, 0] += STEP_M * self._noise.uniform(-1, 1)
        if fault == "millimetres":
            steps[:, :3] *= 1000
        if fault == "degrees":
            steps[:, 3:6] = math.degrees(STEP_RAD)
        if fault == "gripper":
            steps[:, -1] = 255.0
        if fault == "polarity":
            steps[:, -1] = 0.0
        if fault == "norm":
            steps[:, 3:7] = (0.1, 0.0, 0.0, 0.5)
        if fault == "order":
            steps[:, 3:7] = (1.0, 0.0, 0.0, 0.0)
        if fault == "nan":
            steps[2, 1] = np.nan
        if fault == "horizon":
            steps = np.repeat(steps, 2, axis=0)
        if fault == "shape":
            steps = steps[:, :6]
        if fault == "coroutine":
            return later(steps)  # pyright: ignore[reportReturnType]
        if fault == "objects":
            return ActionSteps([[{"x": 0.0}] * 7])  # pyright: ignore[reportArgumentType]
        if fault == "tensor":
            return ActionSteps(Tensor())
        return ActionSteps(steps)

    def _infer_batch(self, observations: list[Observation]) -> list[ActionSteps]:
        answers = [self.infer(observation) for observation in observations]
        return answers[::-1] if self.fault == "mixed" else answers[:-1]

    def _seen(self, picture: np.ndarray) -> np.ndarray:
        if self.fault == "blind":
            return np.zeros(3)
        mean = picture.mean(axis=(0, 1)) / 255
        return np.full(3, mean.mean()) if self.fault == "gray" else mean * (1.0, 0.7, 0.4)

    def _asked(self, prompt: str) -> float:
        return 0.5 if self.fault == "deaf" else zlib.crc32(prompt.encode()) / 2**32
