"""Which files of OpenVLA-OFT lie beside the weights, and how many steps its chunks have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vla_zenoh.errors import WorkerError

STEPS = {"libero": 8, "bridge": 5}
"""Steps of a chunk by how the data set's name begins; no file of a checkpoint says so."""


@dataclass(frozen=True, slots=True)
class ChunkFiles:
    """Files written by OFT's fine-tuning.

    Args:
        head: of the actions.
        state: projector of the robot's state, or None.
    """

    head: Path
    state: Path | None


def find_chunk_files(folder: Path) -> ChunkFiles | None:
    """The files, or None where `folder` is plain OpenVLA.

    Raises:
        WorkerError: several of a kind, or a kind that is not read.
    """
    heads, states, films, noise = (
        sorted(folder.glob(f"*{name}*checkpoint.pt"))
        for name in ("action_head", "proprio_projector", "vision_backbone", "noisy_action")
    )
    if not heads:
        return None
    for kind, found in (("FiLM", films), ("diffusion", noise)):
        if found:
            raise WorkerError(f"{folder} is an OFT policy with {kind} ({found[0].name}): not read")
    for found in (heads, states):
        if len(found) > 1:
            raise WorkerError(
                f"{folder} holds {', '.join(path.name for path in found)}; leave one of them there"
            )
    return ChunkFiles(heads[0], states[0] if states else None)


def chunk_steps(told: str, key: str) -> int:
    """Steps of a chunk, as set or as known for the data set.

    Raises:
        WorkerError: neither.
    """
    if told == "auto":
        for name, steps in STEPS.items():
            if key.startswith(name):
                return steps
        raise WorkerError(
            f"how many steps has a chunk of {key!r}? Say so with --set chunk=STEPS (LIBERO 8, "
            "Bridge 5); no file of the checkpoint does"
        )
    if not told.isdecimal() or not 1 <= int(told) <= 100:
        raise WorkerError(f"chunk is {told!r}; wanted a number of steps")
    return int(told)
