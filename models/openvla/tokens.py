"""Text and action tokens of OpenVLA (Kim et al., CoRL 2024): prompt in, numbers out.

An action is one token a dimension. The tokens are the last `n_action_bins` of the text vocabulary,
counted from its end, and stand for the centres of equal bins of [-1, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError

BLANK_TOKEN = 29871
"""The blank piece of Llama's vocabulary: in training it stood between the prompt and the action."""

PROMPTS = {
    "7b": "In: What action should the robot take to {task}?\nOut:",
    "v01": (
        "A chat between a curious user and an artificial intelligence assistant. "
        "The assistant gives helpful, detailed, and polite answers to the user's questions. "
        "USER: What action should the robot take to {task}? ASSISTANT:"
    ),
}


def prompt_text(template: str, task: str) -> str:
    """The text that the model was trained with, for a task in a person's words."""
    return PROMPTS[template].format(task=task.strip().lower())


def prompt_tokens(ids: Sequence[int]) -> list[int]:
    """Tokens of the prompt with the blank one at the end, where the tokenizer left it out."""
    return [*ids] if ids and ids[-1] == BLANK_TOKEN else [*ids, BLANK_TOKEN]


@dataclass(frozen=True, slots=True)
class ActionBins:
    """Which token means which number.

    Args:
        vocabulary: text tokens without the padding to a round number, 32000 for Llama 2.
        count: edges of bins; there is one centre fewer.
    """

    vocabulary: int
    count: int = 256

    def centres(self) -> NDArray[np.float64]:
        """(count - 1,) middle of each bin in [-1, 1]."""
        edges = np.linspace(-1.0, 1.0, self.count)
        return (edges[:-1] + edges[1:]) / 2

    def decode(self, tokens: Sequence[int]) -> NDArray[np.float64]:
        """(D,) numbers in [-1, 1]. The two last tokens share a centre, as published.

        Raises:
            SpecError: a token that is not an action's. The published code takes it for the largest
                motion there is.
        """
        ids = np.asarray(tokens, dtype=np.int64)
        first = self.vocabulary - self.count
        strange = np.flatnonzero((ids < first) | (ids >= self.vocabulary))
        if len(strange):
            raise SpecError(
                f"the model answered with token {ids[strange[0]]} as number {strange[0]} of its "
                f"action; actions are {first} to {self.vocabulary - 1}. Are these weights "
                "trained for actions, and is the prompt template the right one?"
            )
        return self.centres()[np.clip(self.vocabulary - ids - 1, 0, self.count - 2)]

    def encode(self, numbers: Sequence[float]) -> NDArray[np.int64]:
        """(D,) tokens for numbers, which are clipped to [-1, 1]."""
        edges = np.linspace(-1.0, 1.0, self.count)
        return self.vocabulary - np.digitize(np.clip(numbers, -1.0, 1.0), edges)
