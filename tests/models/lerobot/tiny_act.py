"""A tiny ACT with random weights, saved by LeRobot itself. ``python tiny_act.py DIR`` makes one."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

STATE_SIZE, ACTION_SIZE, CHUNK, STEPS = 7, 7, 12, 8
HEIGHT, WIDTH = 96, 128
STATISTICS: dict[str, dict[str, torch.Tensor]] = {
    "observation.images.front": {
        "mean": torch.tensor([0.4, 0.5, 0.6]).view(3, 1, 1),
        "std": torch.tensor([0.2, 0.25, 0.3]).view(3, 1, 1),
    },
    "observation.state": {
        "mean": torch.linspace(-0.5, 0.5, STATE_SIZE),
        "std": torch.linspace(0.5, 1.5, STATE_SIZE),
    },
    "action": {
        "mean": torch.tensor([0.002, -0.001, 0.003, 0.0, 0.01, -0.01, 0.5]),
        "std": torch.tensor([0.004, 0.004, 0.004, 0.01, 0.01, 0.01, 0.05]),
    },
}


def write(
    folder: Path,
    action: Mapping[str, torch.Tensor] = STATISTICS["action"],
    state: Mapping[str, torch.Tensor] = STATISTICS["observation.state"],
    statistics: Mapping[str, Any] | None = None,
    **changes: Any,
) -> ACTPolicy:
    """Save a policy with its pipelines.

    Args:
        folder: is made.
        action: statistics of its actions.
        state: statistics of the state.
        statistics: all that are saved; None: those.
        changes: of its config.
    """
    torch.manual_seed(0)
    features: Mapping[str, PolicyFeature] = {
        "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH)),
        "observation.state": PolicyFeature(FeatureType.STATE, tuple(state["mean"].shape)),
    }
    config = ACTConfig(
        **{
            "input_features": dict(features),
            "output_features": {
                "action": PolicyFeature(FeatureType.ACTION, tuple(action["mean"].shape))
            },
            "device": "cpu",
            "chunk_size": CHUNK,
            "n_action_steps": STEPS,
            "dim_model": 32,
            "n_heads": 2,
            "dim_feedforward": 64,
            "n_encoder_layers": 1,
            "n_vae_encoder_layers": 1,
            "latent_dim": 4,
            "pretrained_backbone_weights": None,
            **changes,
        }
    )
    policy = ACTPolicy(config).eval()
    own = {**STATISTICS, "action": dict(action), "observation.state": dict(state)}
    saved = own if statistics is None else dict(statistics)
    before, after = make_pre_post_processors(config, dataset_stats=saved)
    # As after a real training: the file names weights that would be fetched.
    config.pretrained_backbone_weights = "ResNet18_Weights.IMAGENET1K_V1"
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return policy


if __name__ == "__main__":
    write(Path(sys.argv[1]))
