"""The image that every way carries: a scene-like gradient with a sensor's noise on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 480
NOISE_SIGMA = 2.0
"""Grey levels of 256. Without noise PNG and JPEG would be far smaller than a camera's."""


def noisy_picture(width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> NDArray[np.uint8]:
    """RGB uint8 (height, width, 3); those of two seeds differ by their noise."""
    across = np.linspace(40.0, 200.0, width)[None, :, None]
    down = np.linspace(0.0, 40.0, height)[:, None, None]
    noise = np.random.default_rng(seed).normal(0.0, NOISE_SIGMA, (height, width, 3))
    return np.clip(across + down + noise, 0, 255).astype(np.uint8)
