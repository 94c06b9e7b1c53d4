"""Gamepad and SpaceMouse as operator input: x forward, y left, z up, as in ROS REP 103."""

from __future__ import annotations

import os
from typing import Any

from vla_zenoh.errors import NodeError, PeerError, in_words
from vla_zenoh_teleop.policy import OperatorInput, clipped_twist, without_dead_zone

MAX_READS = 64
"""A SpaceMouse sends states faster than they are read: only the newest counts."""


class Button:
    """Counts the presses of a button."""

    def __init__(self) -> None:
        self._count, self._was_down = 0, False

    def pressed(self, down: bool) -> int:
        """Presses so far, of a button that is up or down now."""
        self._count += down and not self._was_down
        self._was_down = down
        return self._count


class Gamepad:
    """The first gamepad that SDL knows.

    Left stick: x and y; right stick: z and about z; D-pad: about x and y; triggers: close and open
    the gripper; A: toggle it; Y: take the arm, and give it back.

    Raises:
        NodeError: no gamepad.
    """

    def __init__(self) -> None:
        # SDL needs a video driver for its events; the dummy one is enough.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame
        from pygame._sdl2 import controller

        self._pygame = pygame
        pygame.display.init()
        controller.init()
        known = [at for at in range(controller.get_count()) if controller.is_controller(at)]
        if not known:
            pygame.quit()
            raise NodeError(
                "no gamepad is connected, or SDL does not know it; plug one in, or leave "
                "--device out and use the keyboard"
            )
        self._pad: Any = controller.Controller(known[0])
        self.name = str(self._pad.name)
        self._toggle, self._takeover = Button(), Button()

    def read(self) -> OperatorInput:
        pygame, pad = self._pygame, self._pad
        pygame.event.pump()
        pygame.event.clear()
        if not pad.attached():
            raise PeerError(
                "device_lost", f"gamepad {self.name!r} is gone; plug it in and start again"
            )

        def axis(number: int) -> float:
            return without_dead_zone(pad.get_axis(number) / 32767)

        def button(number: int) -> float:
            return float(pad.get_button(number))

        twist = (
            -axis(pygame.CONTROLLER_AXIS_LEFTY),
            -axis(pygame.CONTROLLER_AXIS_LEFTX),
            -axis(pygame.CONTROLLER_AXIS_RIGHTY),
            button(pygame.CONTROLLER_BUTTON_DPAD_RIGHT)
            - button(pygame.CONTROLLER_BUTTON_DPAD_LEFT),
            button(pygame.CONTROLLER_BUTTON_DPAD_UP) - button(pygame.CONTROLLER_BUTTON_DPAD_DOWN),
            -axis(pygame.CONTROLLER_AXIS_RIGHTX),
        )
        wider = axis(pygame.CONTROLLER_AXIS_TRIGGERLEFT)
        narrower = axis(pygame.CONTROLLER_AXIS_TRIGGERRIGHT)
        return OperatorInput(
            clipped_twist(twist),
            wider - narrower,
            self._toggle.pressed(bool(pad.get_button(pygame.CONTROLLER_BUTTON_A))),
            self._takeover.pressed(bool(pad.get_button(pygame.CONTROLLER_BUTTON_Y))),
        )

    def close(self) -> None:
        self._pygame.quit()


class SpaceMouse:
    """The first 3Dconnexion SpaceMouse.

    Its first button toggles the gripper, its second takes the arm and gives it back.

    Raises:
        NodeError: no SpaceMouse, it cannot be opened, or the library hidapi is missing.
    """

    def __init__(self) -> None:
        import pyspacemouse

        try:
            self._mouse: Any = pyspacemouse.open(axis_convention=pyspacemouse.AxisConvention.ROS)
        except Exception as error:  # of the system's HID library too
            raise NodeError(
                f"no SpaceMouse can be used: {in_words(error)}. It needs the system's hidapi "
                "(Debian: libhidapi-hidraw0) and read access to /dev/hidraw*; or leave --device "
                "out and use the keyboard"
            ) from error
        self.name = str(self._mouse.name)
        self._toggle, self._takeover = Button(), Button()

    def read(self) -> OperatorInput:
        try:
            state = self._mouse.read()
            for _ in range(MAX_READS):
                before = state.t
                state = self._mouse.read()
                if state.t == before:
                    break
        except Exception as error:
            raise PeerError("device_lost", f"{self.name} is gone: {in_words(error)}") from error
        first, second = (*map(bool, state.buttons or ()), False, False)[:2]
        axes = (state.x, state.y, state.z, state.roll, state.pitch, state.yaw)
        return OperatorInput(
            clipped_twist([without_dead_zone(axis) for axis in axes]),
            0.0,
            self._toggle.pressed(first),
            self._takeover.pressed(second),
        )

    def close(self) -> None:
        self._mouse.close()


DEVICES: dict[str, type[Gamepad] | type[SpaceMouse]] = {
    "gamepad": Gamepad,
    "spacemouse": SpaceMouse,
}
