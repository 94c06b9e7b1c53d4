"""A tiny SmolVLA with random weights, saved by LeRobot itself.

Its backbone, processor and words are made here too, in transformers' own classes: nothing is
fetched. Whatever the network answers, its statistics make it the posture `mean` within a few
times `std`.
"""

from __future__ import annotations

from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import (
    PreTrainedTokenizerFast,
    SmolVLMConfig,
    SmolVLMImageProcessor,
    SmolVLMProcessor,
    SmolVLMVideoProcessor,
)

CHUNK = 20
WORDS = ("hold", "the", "brick", "\n")
ENDS = ("<pad>", "<unk>", "<s>", "</s>", "<end_of_utterance>")
PICTURES = ("<image>", "<fake_token_around_image>", "<global-img>")
PICTURE_PIXELS, PATCH_PIXELS = 64, 16


def write_backbone(folder: Path) -> None:
    """Save a vision-language model of two small layers."""
    words = {word: index for index, word in enumerate((*ENDS, *PICTURES, *WORDS))}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    kept = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token="<pad>",
        unk_token="<unk>",
        bos_token="<s>",
        eos_token="</s>",
        extra_special_tokens={
            "image_token": "<image>",
            "fake_image_token": "<fake_token_around_image>",
            "global_image_token": "<global-img>",
            "end_of_utterance_token": "<end_of_utterance>",
        },
    )
    size = {"longest_edge": PICTURE_PIXELS}
    config = SmolVLMConfig(
        image_token_id=words["<image>"],
        pad_token_id=0,
        scale_factor=2,
        text_config={
            "model_type": "llama",
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "num_key_value_heads": 1,
            "head_dim": 16,
            "vocab_size": len(words),
            "pad_token_id": 0,
        },
        vision_config={
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "image_size": PICTURE_PIXELS,
            "patch_size": PATCH_PIXELS,
        },
    )
    processor = SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(size=size, max_image_size=size),
        tokenizer=kept,
        video_processor=SmolVLMVideoProcessor(),
    )
    config.save_pretrained(folder)
    processor.save_pretrained(folder)


def write(folder: Path, mean: list[float], std: list[float]) -> SmolVLAPolicy:
    """Save a policy with its pipelines; its backbone lies in the folder ``vlm`` beside it.

    Args:
        folder: is made.
        mean: (D,) of the actions and of the state, in units of the data.
        std: (D,) likewise.
    """
    torch.manual_seed(0)
    write_backbone(folder.parent / "vlm")
    shape = (len(mean),)
    config = SmolVLAConfig(
        input_features={
            "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 96, 128)),
            "observation.state": PolicyFeature(FeatureType.STATE, shape),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, shape)},
        device="cpu",
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        vlm_model_name=str(folder.parent / "vlm"),
        resize_imgs_with_padding=(PICTURE_PIXELS, PICTURE_PIXELS),
        num_vlm_layers=2,
        max_state_dim=8,
        max_action_dim=8,
    )
    policy = SmolVLAPolicy(config).eval()
    scale = {"mean": torch.tensor(mean), "std": torch.tensor(std)}
    before, after = make_pre_post_processors(
        config, dataset_stats={"observation.state": scale, "action": scale}
    )
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return policy
