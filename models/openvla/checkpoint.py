"""A directory with OpenVLA weights: what is in it, read without unpickling and without its code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.options import read_json

CONFIG, STATISTICS = "config.json", "dataset_statistics.json"
TOKENIZER, ADAPTER_CONFIG = "tokenizer.json", "adapter_config.json"
INDEX, SINGLE = "model.safetensors.index.json", "model.safetensors"

# Values behind the names of published configurations that the files themselves omit.
BACKBONES: Mapping[str, tuple[str, ...]] = {
    "dinosiglip-vit-so-224px": (
        "vit_large_patch14_reg4_dinov2.lvd142m",
        "vit_so400m_patch14_siglip_224",
    ),
    "siglip-vit-so400m": ("vit_so400m_patch14_siglip_224",),
    "dinov2-vit-l": ("vit_large_patch14_reg4_dinov2.lvd142m",),
}


@dataclass(frozen=True, slots=True)
class Backbone:
    """One image encoder.

    Args:
        name: architecture in timm.
        side: pixels of its square input.
        activation: of its layers, where it is not timm's own.
        arguments: sizes that differ from the architecture's, for small copies of it.
    """

    name: str
    side: int
    activation: str | None
    arguments: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Contents of config and statistics.

    Args:
        folder: where it is.
        backbones: one or two.
        text: arguments of transformers' LlamaConfig that differ from its defaults.
        text_vocabulary: tokens without padding.
        bins: edges of action bins.
        template: which prompt it was trained with.
        statistics: data set -> parts -> numbers.
        statistics_file: where those are from, for messages.
    """

    folder: Path
    backbones: tuple[Backbone, ...]
    text: Mapping[str, Any]
    text_vocabulary: int
    bins: int
    template: str
    statistics: Mapping[str, Any]
    statistics_file: str


def read_checkpoint(folder: Path, adapter: Path | None = None) -> Checkpoint:
    """Read the small files.

    Args:
        folder: with ``config.json``.
        adapter: folder of an adapter; its statistics replace those of the base model.

    Raises:
        WorkerError: something is missing or not as published; says what.
    """
    if not (folder / CONFIG).is_file():
        if (folder / ADAPTER_CONFIG).is_file():
            raise WorkerError(
                f"{folder} is a LoRA adapter; name the model it adapts with --set checkpoint= "
                f"and this one with --set adapter={folder}"
            )
        raise WorkerError(f"{folder} holds no {CONFIG}; it is not a checkpoint of OpenVLA")
    config = read_json(folder / CONFIG)
    kind = config.get("model_type")
    if kind != "openvla":
        raise WorkerError(f"{folder / CONFIG}: model_type is {kind!r}, wanted 'openvla'")
    text = config.get("text_config")
    if not isinstance(text, Mapping) or text.get("model_type", "llama") != "llama":
        raise WorkerError(f"{folder / CONFIG}: wanted a text_config of a Llama")
    padded, padding = text.get("vocab_size", 32000), config.get("pad_to_multiple_of", 64)
    bins = config.get("n_action_bins", 256)
    if not all(type(number) is int and number > 0 for number in (padded, padding, bins)):
        raise WorkerError(
            f"{folder / CONFIG}: vocab_size, pad_to_multiple_of and n_action_bins "
            "must be positive whole numbers"
        )
    statistics, where = _statistics(folder, adapter, config)
    # transformers' own bookkeeping, and not parts of the architecture.
    skipped = ("model_type", "torch_dtype", "dtype", "transformers_version", "architectures")
    return Checkpoint(
        folder=folder,
        backbones=_backbones(folder, config),
        text={key: value for key, value in text.items() if key not in skipped},
        text_vocabulary=padded - padding,
        bins=bins,
        template=_template(folder, config),
        statistics=statistics,
        statistics_file=where,
    )


def _backbones(folder: Path, config: Mapping[str, Any]) -> tuple[Backbone, ...]:
    identity = config.get("vision_backbone_id")
    names = config.get("timm_model_ids") or BACKBONES.get(str(identity))
    if not names or len(names) > 2:
        raise WorkerError(
            f"{folder / CONFIG}: vision_backbone_id {identity!r} is not known and timm_model_ids "
            f"do not say what it is; known: {', '.join(BACKBONES)}"
        )
    sides = config.get("image_sizes") or [224] * len(names)
    activations = config.get("timm_override_act_layers") or [None] * len(names)
    arguments = config.get("timm_model_args") or [{}] * len(names)
    if not len(names) == len(sides) == len(activations) == len(arguments):
        raise WorkerError(
            f"{folder / CONFIG}: timm_model_ids, image_sizes and timm_override_act_layers "
            "are not of one length"
        )
    return tuple(
        Backbone(*parts) for parts in zip(names, sides, activations, arguments, strict=True)
    )


def _template(folder: Path, config: Mapping[str, Any]) -> str:
    vicuna = str(config.get("llm_backbone_id", "")).startswith("vicuna")
    return "v01" if vicuna or "v01" in folder.name else "7b"


def _statistics(
    folder: Path, adapter: Path | None, config: Mapping[str, Any]
) -> tuple[Mapping[str, Any], str]:
    beside = [adapter, adapter.parent] if adapter is not None else []
    for place in (*beside, folder):
        file = place / STATISTICS
        if file.is_file():
            return read_json(file), str(file)
    inside = config.get("norm_stats")
    if isinstance(inside, Mapping):
        return inside, f"{folder / CONFIG} (norm_stats)"
    raise WorkerError(
        f"{folder} has neither {STATISTICS} nor norm_stats in its {CONFIG}: "
        "without them actions have no units"
    )


def shards(folder: Path) -> dict[Path, list[str] | None]:
    """Files with weights -> names of their tensors; None: all that are in it.

    Raises:
        WorkerError: there are none, or one that the index names is missing.
    """
    if not (folder / INDEX).is_file():
        if (folder / SINGLE).is_file():
            return {folder / SINGLE: None}
        raise WorkerError(
            f"{folder} has neither {INDEX} nor {SINGLE}; weights in other formats "
            "(.bin, .pt) are pickles and are not read"
        )
    named = read_json(folder / INDEX).get("weight_map")
    if not isinstance(named, dict) or not named:
        raise WorkerError(f"{folder / INDEX} has no weight_map")
    found: dict[Path, list[str] | None] = {}
    for tensor, file in named.items():
        path = folder / str(file)
        if path.parent != folder:
            raise WorkerError(f"{folder / INDEX} names {file!r}, which is not beside it")
        entries = found.setdefault(path, [])
        assert entries is not None
        entries.append(tensor)
    missing = [path.name for path in found if not path.is_file()]
    if missing:
        raise WorkerError(
            f"{folder} lacks {len(missing)} of {len(found)} files of weights: {', '.join(missing)}"
        )
    return found


def tensors(files: Mapping[Path, list[str] | None], device: str) -> Iterator[tuple[str, Any]]:
    """Every tensor by name, one after the other, on `device`.

    Raises:
        WorkerError: a file is damaged or cut off, or lacks a tensor that the index promises.
    """
    from safetensors import SafetensorError, safe_open

    for path, names in files.items():
        try:
            with safe_open(str(path), framework="pt", device=device) as content:
                for name in names or content.keys():
                    yield name, content.get_tensor(name)
        except (SafetensorError, OSError) as error:
            raise WorkerError(
                f"{path} is damaged or was not copied whole: {str(error)[:200]}"
            ) from error
