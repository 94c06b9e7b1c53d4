"""Training sentences for the reader: tasks in many wordings, and sentences that only look like
one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from states import draw_order
from worker import MAX_PIECES, tokens_of

from vla_zenoh.lab.tasks.order import (
    COLOURS,
    DIRECTION_PHRASES,
    DIRECTIONS,
    HELD_OUT,
    NONSENSE,
    Order,
    phrase,
)

KINDS = ("put", "stack", *DIRECTIONS)
NO_TASK = len(KINDS)

BRICKS = ("brick", "brick", "block", "block", "cube", "one", "piece", "lego", "toy brick", "")
BOXES = ("box", "box", "gray box", "grey box", "container", "bin", "crate", "tray", "open box")
ARTICLES = ("the", "the", "the", "the", "a", "that", "this", "my", "")
POLITE_START = (
    "please", "robot", "hey robot", "hey", "ok robot", "now", "now please", "alright",
    "could you", "can you", "would you", "will you", "would you mind to", "could you please",
    "can you please", "would you please", "i want you to", "i need you to", "i would like you to",
    "i'd like you to", "your task is to", "your job is to", "try to", "go and", "next", "then",
    "kindly", "be so kind and", "let us", "we need to", "you should", "please go ahead and",
)  # fmt: skip
POLITE_END = (
    "please", "now", "for me", "robot", "thanks", "thank you", "right now", "if you can",
    "if you would", "will you", "carefully", "gently", "slowly", "quickly", "at once", "ok",
)  # fmt: skip
PUT = (
    "{put} {x} {into} {box}",
    "{put} {x} {into} {box}",
    "{take} {x} and {put} it {into} {box}",
    "{take} {x} , then {put} it {into} {box}",
    "{x} {belongs} {into} {box}",
    "{x} {into} {box}",
    "{into} {box} {put} {x}",
    "{into} {box} with {x}",
    "i want {x} {into} {box}",
    "i want to see {x} {into} {box}",
    "i need {x} {into} {box}",
    "make sure {x} is {into} {box}",
    "make sure that {x} ends up {into} {box}",
    "{box} is where {x} {belongs}",
    "box {x}",
    "get {x} off the table and {into} {box}",
    "{put} {x} away {into} {box}",
    "{x} : {put} it {into} {box}",
    "{box} should hold {x}",
    "let {x} fall {into} {box}",
    "clear {x} away {into} {box}",
    "fill {box} with {x}",
    "have {x} put {into} {box}",
    "have {x} moved {into} {box}",
    "let {x} end up {into} {box}",
    "do {put} {x} {into} {box}",
)
STACK = (
    "{stack} {x} {onto} {y}",
    "{stack} {x} {onto} {y}",
    "{take} {x} and {stack} it {onto} {y}",
    "{take} {x} , then {stack} it {onto} {y}",
    "{x} {belongs} {onto} {y}",
    "{x} {onto} {y}",
    "{onto} {y} {stack} {x}",
    "i want {x} {onto} {y}",
    "i need {x} {onto} {y}",
    "make sure {x} is {onto} {y}",
    "build a tower with {x} {onto} {y}",
    "build a tower , {y} below and {x} above",
    "make a tower of {x} {onto} {y}",
    "make a stack with {y} at the bottom and {x} at the top",
    "{y} below , {x} {above}",
    "{y} is the base , {stack} {x} {onto} it",
    "cover {y} with {x}",
    "{y} should carry {x}",
    "let {x} rest {onto} {y}",
    "use {y} as the base for {x}",
    "top {y} with {x}",
    "have {x} put {onto} {y}",
    "have {x} rest {onto} {y}",
    "do {stack} {x} {onto} {y}",
    "{x} is to be {onto} {y}",
)
PUSH = (
    "{push} {x} {d}",
    "{push} {x} {d}",
    "{push} {x} {some} {d}",
    "{x} {some} {d}",
    "{x} should {go} {d}",
    "{x} must {go} {d}",
    "{x} has to {go} {d}",
    "give {x} a {push} {d}",
    "i want {x} {pushed} {d}",
    "i need {x} {some} {d}",
    "make {x} {go} {d}",
    "get {x} to {go} {d}",
    "{d} with {x}",
    "{d} please , {x}",
    "use your hand to {push} {x} {d}",
    "{push} {d} {x}",
    "{push} {d} against {x}",
    "have {x} {pushed} {d}",
    "have {x} {go} {d}",
    "let {x} {go} {d}",
    "do {push} {x} {d}",
    "{x} is too far the other way , {push} it {d}",
)
SLOTS = {
    "put": (
        "put", "put", "place", "set", "lay", "drop", "move", "bring", "get", "stick", "throw",
        "load", "store", "toss", "deposit", "leave", "dump", "insert", "pack", "carry",
    ),
    "stack": (
        "stack", "stack", "put", "place", "set", "lay", "rest", "balance", "pile", "position",
        "move", "get", "bring", "leave", "sit",
    ),
    "take": (
        "take", "grab", "pick up", "get", "fetch", "lift", "grasp", "pick", "hold", "seize",
        "lift up", "collect",
    ),
    "push": (
        "push", "push", "slide", "shove", "nudge", "move", "shift", "drag", "scoot", "press",
        "sweep",
    ),
    "pushed": ("pushed", "moved", "shifted", "slid", "shoved", "nudged", "a bit more", ""),
    "belongs": ("goes", "belongs", "has to go", "should go", "should be", "must go", "needs to go"),
    "go": ("go", "move", "be", "slide", "end up", "come", "be pushed", "be moved", "travel"),
    "into": ("in", "in", "into", "into", "inside", "to", "inside of", "within"),
    "onto": (
        "on", "on", "onto", "on top of", "on top of", "above", "over", "upon", "atop", "on to",
        "on the top of",
    ),
    "above": ("above", "on top", "over it", "on it", "on top of it"),
    "some": (
        "", "", "a little", "a bit", "some way", "a few centimetres", "10 cm", "slightly",
        "more",
    ),
}  # fmt: skip
WAYS = {
    "left": (
        "to the left", "left", "leftwards", "to your left", "to the left side", "over to the left",
        "towards the left", "toward the left", "in the left direction", "on the left",
        "to the left hand side", "further left", "leftward",
    ),
    "right": (
        "to the right", "right", "rightwards", "to your right", "to the right side",
        "over to the right", "towards the right", "toward the right", "in the right direction",
        "on the right", "to the right hand side", "further right", "rightward",
    ),
    "away": (
        "away", "away from you", "forward", "further away", "forwards", "farther away", "ahead",
        "away from yourself", "farther from you", "farther out", "away from the robot",
        "away from your base", "to the far side", "further from you",
    ),
    "closer": (
        "closer", "closer to you", "towards you", "back towards you", "nearer", "nearer to you",
        "toward you", "toward yourself", "in your direction", "closer to yourself",
        "closer to the robot", "towards your base", "to the near side", "back to you",
    ),
}  # fmt: skip
TOLD = (
    "is {x} {into} {box}",
    "is {x} {onto} {y}",
    "is {x} {d}",
    "are {x} and {y} {into} {box}",
    "was {x} {into} {box}",
    "where is {x}",
    "why is {x} {into} {box}",
    "did {x} {go} {d}",
    "when will {x} be {into} {box}",
    "when does {x} {go} {into} {box}",
    "has {x} been {pushed} {d}",
    "have you {pushed} {x} {d}",
    "did you {put} {x} {into} {box}",
    "have they {stack} {x} {onto} {y}",
    "who has {pushed} {x} {d}",
    "how far {d} is {x}",
    "does {x} lie {onto} {y}",
    "should {x} be {into} {box}",
    "will {x} {go} {d}",
    "which of {x} and {y} is {into} {box}",
    "{x} is {into} {box}",
    "{x} is {into} {box} already",
    "{x} is already {onto} {y}",
    "{x} is {d}",
    "{x} was {pushed} {d} yesterday",
    "{x} lies {onto} {y}",
    "{x} was {into} {box}",
    "{x} has been {pushed} {d}",
    "{x} fell off the table",
    "{x} stands {onto} {y}",
    "i see {x} {into} {box}",
    "i can see {x} {d} of {box}",
    "there is {x} {onto} {y}",
    "we had {x} {into} {box}",
    "they {pushed} {x} {d}",
    "you {pushed} {x} {d} just now",
    "keep {x} out of {box}",
    "{x} must stay out of {box}",
    "leave {x} where it is",
    "{x} stays where it is",
    "leave {x} alone",
    "keep {x} away from {box}",
    "do not touch {x}",
    "{x} may not leave its place",
    "keep your fingers off {x}",
    "look at {x}",
    "point at {x}",
    "find {x}",
    "count {x} and {y}",
    "{x} is nicer than {y}",
    "{x} is not {into} {box}",
    "take {x} out of {box}",
    "remove {x} from {box}",
    "take {x} off {y}",
    "turn {x} around",
    "{take} {x}",
    "{take} {x} and hold it",
    "release {x}",
    "throw {x} out of the window",
)
"""Sentences about bricks that ask for nothing, or for something impossible."""
OTHER_COLOURS = (
    "purple", "orange", "pink", "white", "black", "brown", "golden", "silver", "violet", "rot",
    "big", "small", "left", "other", "wooden", "heavy", "turquoise", "transparent",
)  # fmt: skip
OTHER_THINGS = (
    "elephant", "fridge", "kitchen", "car", "window", "door", "drawer", "cup", "apple", "bottle",
    "house", "moon", "street", "shelf", "bag", "pocket", "pan", "bowl", "mug", "banana", "floor",
    "ball", "shoe", "phone", "tree", "horse", "letter", "dress", "button", "ship", "flag", "lamp",
    "pillow", "orange", "spoon", "key", "hat", "bus", "truck", "river", "fish", "bird", "knife",
    "carpet", "wine", "paper", "coat", "wall", "garden", "plane", "glass", "table", "chair", "book",
    "soldier", "team", "sky", "flower", "cheese", "umbrella", "suitcase", "robot", "line", "card",
)  # fmt: skip
FORBID = (
    "do not", "don't", "never", "please do not", "you must not", "you should not", "dont",
    "please don't", "under no circumstances", "stop , do not", "avoid to", "no , don't",
    "i forbid you to", "refuse to", "it is wrong to", "do not ever", "whatever you do , don't",
    "you are not allowed to", "i do not want you to", "please never", "nobody should",
    "refrain from", "hold back from", "it is not the time to", "you need not", "we decided not to",
    "i asked you not to", "keep from", "in no case", "there is no need to", "resist to",
)  # fmt: skip
DOUBT = (
    "why did you {}", "who {}", "what happens if you {}", "when did they {}", "did you {}",
    "how would one {}", "is it possible to {}", "what if someone {}", "yesterday we {}",
    "was it you who {}", "have you ever {}", "i wonder whether to {}", "{} or not ?",
    "it was me who {}",
    "{} is forbidden", "{} is not allowed", "{} , no , stop", "forget it , {} was a joke",
    "before you {} wait for me", "undo : {}", "cancel : {}", "the opposite of {}",
)  # fmt: skip
SMALL_TALK = (
    "what a day", "how are you", "who are you", "tell me about the box", "look at the brick",
    "where is the red brick", "which brick is the largest", "count the bricks", "is the box empty",
    "what colour is the box", "go home", "open the gripper", "close the gripper", "wave at me",
    "turn around", "move up", "go down", "stop", "stop it", "wait", "be careful", "good job",
    "thank you", "that was wrong", "try again", "do something", "do it", "yes", "no", "maybe",
    "hello", "hello there", "good morning", "the bricks are nice", "i like the red one",
    "the blue brick is on the table", "the box is gray", "there is a brick in the box",
    "it rains", "we went to the sea", "the train leaves at nine", "he reads a book",
    "two plus two is four", "the cat sleeps on the sofa", "write a poem", "play some music",
    "turn on the light", "make coffee", "wash the dishes", "clean the table", "find my keys",
    "call my mother", "what is your name", "describe the scene", "show me the camera",
    "put", "push", "stack", "left", "right", "box", "brick", "red", "put it there", "push it",
    "stack them", "take it", "on top", "in the box", "put the brick", "push the brick left",
    "stack the bricks", "put something in the box", "put the box on the table",
    "put the box on the red brick", "push the box to the left", "stack the box on the blue brick",
    "the quick brown fox jumps over the lazy dog", "once upon a time", "lorem ipsum dolor",
    "import numpy as np", "sudo rm", "select from table", "http www example org", "one two three",
)  # fmt: skip
PARAPHRASES = ("held_out.txt", "final.txt")
NO_TASKS = ("held_out_no_task.txt", "final_no_task.txt")
"""Written by hand. The phrases above were corrected by the errors on the first of each; the second
was evaluated once, at the end."""
KEYBOARD = ("qwertyuiop", "asdfghjkl", "zxcvbnm")
ONSETS = (
    "b", "bl", "br", "c", "cl", "cr", "d", "dr", "f", "fl", "fr", "g", "gl", "gr", "h", "j", "k",
    "l", "m", "n", "p", "pl", "pr", "qu", "r", "s", "sk", "sl", "sn", "st", "t", "tr", "v", "w",
    "y", "z",
)  # fmt: skip
VOWELS = ("a", "e", "i", "o", "u", "ee", "oo", "ou", "ai", "ue")
ENDS = (
    "", "", "b", "ck", "d", "ft", "g", "ll", "m", "n", "nk", "p", "r", "rt", "sh", "t", "tz", "x",
)  # fmt: skip
TYPO_SHARE = 0.22


def lines_of(name: str) -> list[str]:
    """Sentences of a file beside this one."""
    return Path(__file__).with_name(name).read_text("utf-8").splitlines()


def held_out() -> list[tuple[str, str]]:
    """Sentences that are never trained with, and their meaning: ``put red``, ``stack red blue``,
    ``left red`` and the like, or nothing if they are no task."""
    found = [("", line) for name in NO_TASKS for line in lines_of(name)]
    for name in PARAPHRASES:
        for line in lines_of(name):
            meaning, _, sentence = line.partition(": ")
            found.append((meaning, sentence))
    return found


class Phrases:
    """Draws sentences with their meaning.

    Args:
        pieces: word pieces, as `encoder.pieces` lists them.
    """

    def __init__(self, pieces: list[str]) -> None:
        self._numbers = {piece: index + 2 for index, piece in enumerate(pieces)}
        self._held_out = {sentence.lower() for _, sentence in held_out()} | {*NONSENSE}
        self._held_out |= {
            wording.format(x=x, y=y, d=d)
            for wordings in HELD_OUT.values()
            for wording in wordings
            for x in COLOURS
            for y in COLOURS
            for ways in DIRECTION_PHRASES.values()
            for d in ways
        }

    def draw(self, random: np.random.Generator) -> tuple[str, int, int, int]:
        """Sentence, kind (`NO_TASK`: none), target and onto (-1: none)."""
        while (found := self._any(random))[0] in self._held_out:
            pass
        return found

    def batch(self, random: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
        """Tokens (n, MAX_PIECES), kind, target, onto (n,)."""
        tokens = np.zeros((count, MAX_PIECES), np.int64)
        meant = np.zeros((count, 3), np.int64)
        for row in range(count):
            sentence, *meaning = self.draw(random)
            tokens[row], meant[row] = tokens_of(sentence, self._numbers), meaning
        return tokens, meant[:, 0], meant[:, 1], meant[:, 2]

    def _any(self, random: np.random.Generator) -> tuple[str, int, int, int]:
        order = draw_order(random)
        kind = order.direction if order.family == "push" else order.family
        if random.uniform() < 0.58:
            text = self._task(order, random)
            onto = COLOURS.index(order.onto) if order.onto else -1
            return text, KINDS.index(kind), COLOURS.index(order.target), onto
        return self._no_task(order, random), NO_TASK, -1, -1

    def _task(self, order: Order, random: np.random.Generator, *, bare: bool = False) -> str:
        if random.uniform() < 0.15:
            text = phrase(order, int(random.integers(1 << 30)))
        else:
            text = self._made(order, random)
        if not bare:
            if random.uniform() < 0.3:
                text = f"{_pick(random, POLITE_START)} {text}"
            if random.uniform() < 0.25:
                text = f"{text} {_pick(random, POLITE_END)}"
            if random.uniform() < TYPO_SHARE:
                text = _with_typo(text, random)
        return text

    @staticmethod
    def _made(order: Order, random: np.random.Generator, wordings: tuple[str, ...] = ()) -> str:
        text = _pick(random, wordings or {"put": PUT, "stack": STACK, "push": PUSH}[order.family])
        for slot, words in SLOTS.items():
            while f"{{{slot}}}" in text:
                text = text.replace(f"{{{slot}}}", _pick(random, words), 1)
        named = _pick(random, ("{a} {c} {b}",) * 9 + ("{b} that is {c}", "{a} {b} which is {c}"))
        other = order.onto or str(random.choice(COLOURS))
        for name, colour in (("x", order.target), ("y", other)):
            thing = named.format(a=_pick(random, ARTICLES), c=colour, b=_pick(random, BRICKS))
            text = text.replace(f"{{{name}}}", thing)
        article = _pick(random, ("the", "the", "the", "that", ""))
        text = text.replace("{box}", f"{article} {_pick(random, BOXES)}")
        way = order.direction or str(random.choice(list(DIRECTIONS)))
        text = text.replace("{d}", _pick(random, WAYS[way]))
        return " ".join(text.split())

    def _no_task(self, order: Order, random: np.random.Generator) -> str:
        """A sentence that is no task, or not one that may be executed."""
        text = self._task(order, random, bare=bool(random.uniform() < 0.7))
        way = int(random.integers(15))
        if way == 14:
            way = 9
        if way > 10:
            return self._made(order, random, TOLD)
        words = text.split()
        colours = [word for word in words if word in COLOURS]
        if way in (0, 1):
            return f"{_pick(random, FORBID)} {text}"
        if way == 2:
            return _pick(random, DOUBT).format(text)
        if way in (3, 4) and colours:  # a brick that is not there, or none that is named
            wrong = str(random.choice(colours))
            other = _pick(random, (*OTHER_COLOURS, *OTHER_COLOURS, ""))
            return " ".join(text.replace(wrong, other, 1).split())
        if way == 5:  # another thing in its place
            thing = _pick(random, OTHER_THINGS)
            names = [word for word in words if word in (*BRICKS, *BOXES) and word]
            if names:
                return text.replace(str(random.choice(names)), thing, 1)
            return f"{text} {thing}"
        if way == 6:  # broken off before it says what
            at = next((i for i, word in enumerate(words) if word in COLOURS), 1)
            return " ".join(words[: max(1, at)])
        if way == 7:
            return _pick(random, SMALL_TALK)
        if way == 8:  # words as they come
            count = int(random.integers(1, 9))
            pool = [*words, *OTHER_THINGS, *COLOURS, *" ".join(SMALL_TALK).split()]
            return " ".join(str(word) for word in random.choice(pool, count))
        if way == 9:  # letters as they come
            count = int(random.integers(1, 6))
            return " ".join(_made_up(random) for _ in range(count))
        if way == 10 and random.uniform() < 0.5:  # a word that does not exist in a good place
            at = int(random.integers(len(words)))
            swap = {at, *(i for i, word in enumerate(words) if word in COLOURS)}
            return " ".join(_made_up(random) if i in swap else w for i, w in enumerate(words))
        if order.family == "stack":  # on itself
            return text.replace(order.onto, order.target)
        chosen = random.choice(COLOURS, int(random.integers(2, 5)))
        between = _pick(random, ("", "brick", "block", "the", "and"))
        return " ".join(f"{colour} {between}" for colour in chosen)


def _pick(random: np.random.Generator, words: tuple[str, ...]) -> str:
    return words[int(random.integers(len(words)))]


def _made_up(random: np.random.Generator) -> str:
    """A word that does not exist: letters, or pronounceable syllables."""
    if random.uniform() < 0.3:
        letters = list("abcdefghijklmnopqrstuvwxyz")
        return "".join(random.choice(letters, int(random.integers(2, 9))))
    said = ""
    for _ in range(int(random.integers(1, 4))):
        said += _pick(random, ONSETS) + _pick(random, VOWELS) + _pick(random, ENDS)
    return said


def _with_typo(text: str, random: np.random.Generator) -> str:
    """One or two letters wrong, none of them at the beginning of a word."""
    letters = list(text)
    for _ in range(int(random.integers(1, 3))):
        inner = [
            at
            for at in range(1, len(letters) - 1)
            if letters[at].isalpha() and letters[at - 1].isalpha()
        ]
        if not inner:
            break
        at = int(random.choice(inner))
        way = int(random.integers(4))
        if way == 0:
            del letters[at]
        elif way == 1:
            letters.insert(at, letters[at])
        elif way == 2:
            letters[at - 1], letters[at] = letters[at], letters[at - 1]
        else:
            row = next((row for row in KEYBOARD if letters[at] in row), "e")
            place = row.find(letters[at])
            letters[at] = row[max(0, min(len(row) - 1, place + int(random.choice([-1, 1]))))]
    return "".join(letters)
