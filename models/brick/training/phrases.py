"""Sentences to learn to read from: tasks in many words, and what only looks like one."""

from __future__ import annotations

import numpy as np
from states import draw_order
from worker import MAX_WORDS, UNKNOWN, words_of

from vla_zenoh.lab.tasks import COLOURS, DIRECTIONS, TRAINING, Order, phrase
from vla_zenoh.lab.tasks.wording import DIRECTION_PHRASES

KINDS = ("put", "stack", *DIRECTIONS)
NO_TASK = len(KINDS)
SAME = (
    ("brick", "block", "one"),
    ("box", "container", "bin"),
    ("put", "place", "set", "lay"),
    ("grab", "take", "get", "fetch"),
    ("push", "slide", "shove", "nudge"),
    ("gray", "grey"),
    ("into", "in", "inside"),
    ("onto", "on"),
    ("could", "can", "would"),
)
"""Words that mean the same in a task."""
POLITE = ("please", "now", "robot", "hey", "then", "so")
NEGATIVE = ("not", "don't", "never", "no", "stop", "without")
ARTICLES = ("the", "a", "that", "this", "my")
ASK = ("could you", "can you", "please", "now", "robot", "i want you to", "would you please")
FILLERS = ("open", "close", "what", "is", "are", "where", "it", "and", "or", "hello", "left", "up")


def vocabulary() -> list[str]:
    """Every word a sentence may have, sorted."""
    words: set[str] = {*COLOURS, *POLITE, *NEGATIVE, *ARTICLES, *FILLERS}
    words.update(word for group in SAME for word in group)
    for request in ASK:
        words.update(request.split())
    for wordings in TRAINING.values():
        for wording in wordings:
            words.update(words_of(wording.format(x="", y="", d="")))
    for ways in DIRECTION_PHRASES.values():
        words.update(word for way in ways for word in way.split())
    return sorted(words)


class Phrases:
    """Draws sentences as token numbers with what they mean.

    Args:
        words: the vocabulary; 0 is padding, 1 unknown.
    """

    def __init__(self, words: list[str]) -> None:
        self._words = words
        self._number = {word: index + 2 for index, word in enumerate(words)}

    def draw(self, random: np.random.Generator) -> tuple[list[int], int, int, int]:
        """Tokens, kind (`NO_TASK`: none), target and onto (-1: none)."""
        order = draw_order(random)
        words = words_of(phrase(order, int(random.integers(1 << 30))))
        words = self._vary(words, random)
        if random.uniform() < 0.62:
            kind = order.direction if order.family == "push" else order.family
            onto = COLOURS.index(order.onto) if order.onto else -1
            return self._numbers(words), KINDS.index(kind), COLOURS.index(order.target), onto
        return self._spoilt(words, order, random), NO_TASK, -1, -1

    def _vary(self, words: list[str], random: np.random.Generator) -> list[str]:
        out: list[str] = []
        loose = random.uniform() < 0.7
        for word in words:
            group = next((g for g in SAME if word in g), None)
            # "on" is part of a stack, "in" of the box: neither may become the other.
            if group is not None and random.uniform() < (0.5 if loose else 0.0):
                word = str(random.choice(group))
            if word == "the" and random.uniform() < 0.12:
                word = str(random.choice(["", *ARTICLES]))
            out += [word] if word else []
        if random.uniform() < 0.25:
            out = str(random.choice(ASK)).split() + out
        if random.uniform() < 0.2:
            out = [*out, str(random.choice(POLITE))]
        return out

    def _spoilt(self, words: list[str], order: Order, random: np.random.Generator) -> list[int]:
        """A sentence that is no task."""
        way = int(random.integers(8))
        numbers = self._numbers(words)
        colours = [i for i, word in enumerate(words) if word in COLOURS]
        if way == 0:  # no such brick
            numbers[int(random.choice(colours))] = UNKNOWN
        elif way == 1:  # which brick?
            del numbers[colours[0]]
        elif way == 2:  # forbidden
            negative = str(
                random.choice(["do not", "don't", "never", "please do not", "you must not"])
            )
            numbers = self._numbers(negative.split()) + numbers
        elif way == 3:  # broken off before it says where
            numbers = numbers[: max(1, min(colours) + int(random.integers(0, 2)))]
        elif way == 4:  # several words nobody knows
            for index in random.permutation(len(numbers))[: max(2, len(numbers) // 2)]:
                numbers[index] = UNKNOWN
        elif way == 5:  # words as they come
            count = int(random.integers(1, 9))
            numbers = [int(n) for n in random.integers(1, len(self._words) + 2, count)]
            for index in range(count):
                if random.uniform() < 0.4:
                    numbers[index] = UNKNOWN
        elif way == 6:  # nothing but unknown words, with small ones between
            small = self._numbers(["the", "is", "a", "in", "to", "you", "what", "brick", "on"])
            numbers = [
                UNKNOWN if random.uniform() < 0.65 else int(random.choice(small))
                for _ in range(int(random.integers(1, 10)))
            ]
        elif order.family == "stack":  # on itself
            for index in colours:
                numbers[index] = self._number[order.target]
        else:  # a list of colours or bricks
            word = str(random.choice(["", "brick", "block", "the", "and"]))
            chosen = random.choice(COLOURS, int(random.integers(1, 5)))
            numbers = self._numbers([w for c in chosen for w in (str(c), word) if w])
        return numbers

    def _numbers(self, words: list[str]) -> list[int]:
        return [self._number.get(word, UNKNOWN) for word in words]

    def batch(self, random: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
        """Tokens (n, MAX_WORDS), kind, target, onto (n,)."""
        tokens = np.zeros((count, MAX_WORDS), np.int64)
        meant = np.zeros((count, 3), np.int64)
        for row in range(count):
            numbers, *meaning = self.draw(random)
            numbers = numbers[:MAX_WORDS]
            tokens[row, : len(numbers)], meant[row] = numbers, meaning
        return tokens, meant[:, 0], meant[:, 1], meant[:, 2]
