"""Which keys are held, and what that means for the arm."""

from __future__ import annotations

from vla_zenoh.lab.teleop.keystrokes import How, Stroke
from vla_zenoh.lab.teleop.operator_input import AXES, OperatorInput, as_twist

HOLD_S = 0.15
"""Where releases are not told, a key counts as held for so long after it was typed: repeats come
at 20 to 30 Hz."""

MOVES: dict[str, tuple[int, float]] = {
    "w": (0, 1.0),
    "s": (0, -1.0),
    "a": (1, 1.0),
    "d": (1, -1.0),
    "r": (2, 1.0),
    "f": (2, -1.0),
    "l": (3, 1.0),
    "j": (3, -1.0),
    "i": (4, 1.0),
    "k": (4, -1.0),
    "u": (5, 1.0),
    "o": (5, -1.0),
}
"""Key -> axis of the twist and direction."""
OPENINGS = {".": 1.0, ",": -1.0}
TOGGLE = "space"
LEVELS = "12345"
QUIT, STOP, SWITCH, GIVE = "quit", "stop", "switch", "give"
ORDERS = {"q": QUIT, "ctrl+c": QUIT, "x": STOP, "enter": SWITCH, "tab": GIVE}
"""Keys that are said once: end, emergency stop, activate or deactivate, take or give the arm."""

LEGEND = """\
  w/s  x forward, back     l/j  turn about x     space  gripper         enter  (de)activate
  a/d  y left, right       i/k  turn about y     . ,    wider, less     tab    take or give
  r/f  z up, down          u/o  turn about z     1-5    speed           x STOP      q end"""


class Keyboard:
    """Held keys of a terminal. Time is the caller's, in s, of any steady clock.

    Attributes:
        level: chosen speed, from 0.
        tells_releases: this terminal says when a key is let go.
    """

    def __init__(self, level: int = 2) -> None:
        self.level = level
        self.tells_releases = False
        self._until_s: dict[str, float] = {}
        self._new: set[str] = set()
        self._toggles = 0

    def take(self, stroke: Stroke, now_s: float) -> str | None:
        """One stroke; the order it gives, if it gives one."""
        key, how = stroke
        if key == "releases":
            self.tells_releases = True
        elif key == "unfocused":  # its releases will not be told
            self.let_go()
        elif key in MOVES or key in OPENINGS:
            self._hold(key, how, now_s)
        elif how in (How.TYPED, How.PRESSED):
            if key == TOGGLE:
                self._toggles += 1
            elif key in LEVELS:
                self.level = LEVELS.index(key)
            return ORDERS.get(key)
        return None

    def _hold(self, key: str, how: How, now_s: float) -> None:
        if how is How.RELEASED:
            self._until_s.pop(key, None)
            return
        if key not in self._until_s:
            self._new.add(key)
        self._until_s[key] = now_s + HOLD_S if how is How.TYPED else float("inf")

    def let_go(self) -> None:
        """No key is held any more."""
        self._until_s.clear()
        self._new.clear()

    def wish(self, now_s: float) -> OperatorInput:
        """What is wanted since the last look: a key that was only tapped counts once."""
        self._until_s = {key: until for key, until in self._until_s.items() if until > now_s}
        down = self._new | set(self._until_s)
        self._new = set()
        twist = [0.0] * AXES
        for key in down & MOVES.keys():
            axis, sign = MOVES[key]
            twist[axis] += sign
        opening = sum(OPENINGS[key] for key in down & OPENINGS.keys())
        return OperatorInput(as_twist(twist), opening, self._toggles)
