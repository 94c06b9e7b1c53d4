"""Example observations made from a spec: test images, prompts, states of the arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.policy import CameraSpec, DepthSpec, ModelSpec, Observation
from vla_zenoh.policy.observation import prepare_depth, prepare_image
from vla_zenoh.policy.spec import FIELD_OF
from vla_zenoh.profile import Profile
from vla_zenoh.types import Depth, GripperState, Image, JointState, PoseState, PrivilegedState, Task

PROMPTS = ("put the red brick in the box", "push the blue brick to the left", "hold")
"""Default prompts: two ask for different motions, one for none."""
STRANGE_PROMPT = "legt den grünen Klotz in die Kiste \N{PACKAGE}, bitte! " * 8
"""Long, in another language, not ASCII: a model may reject it, and must not break."""
DEFAULT_SIZE = (480, 640)
UNMEASURED_PX = 8
PERIOD_NS = 200_000_000
START_NS = 1_700_000_000_000_000_000
MAX_WIDTH_M = 0.08
HOME_M, DOWN_XYZW = (0.43, 0.0, 0.16), (1.0, 0.0, 0.0, 0.0)
TILTED_XYZW = (0.9, 0.3, 0.1, 0.3)
"""Where the tool points straight down, rows and columns of a rotation are the same."""

Picture = NDArray[np.uint8]


def chart(height: int, width: int) -> Picture:
    """RGB bars, a gray ramp below, a white square in the top left corner, and a round patch.

    No two of its mirror images and channel orders are alike.
    """
    bars = np.array(
        [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255], [200, 90, 30]],
        np.uint8,
    )
    columns = np.arange(width) * len(bars) // width
    picture = np.repeat(bars[columns][None], height, axis=0)
    ramp = (np.arange(width) * 255 // max(width - 1, 1)).astype(np.uint8)
    picture[3 * height // 4 :] = ramp[None, :, None]
    picture[: height // 8, : width // 8] = 255
    rows, columns = np.ogrid[:height, :width]
    apart_px = np.hypot(rows - height // 3, columns - 2 * width // 3)
    picture[apart_px <= max(2, height // 8)] = (180, 0, 90)
    return picture


def noise(height: int, width: int) -> Picture:
    """Noise of a fixed seed, coarse enough to survive a resize."""
    small = np.random.default_rng(7).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    rows, columns = np.arange(height) * 12 // height, np.arange(width) * 16 // width
    return small[rows[:, None], columns]


def plain(value: int) -> Callable[[int, int], Picture]:
    return lambda height, width: np.full((height, width, 3), value, np.uint8)


@dataclass(frozen=True, slots=True)
class ExampleStyle:
    """Style of one example observation.

    Args:
        picture: of every camera, from height and width, RGB.
        strange: the model may reject it with a `SpecError`.
    """

    name: str
    picture: Callable[[int, int], Picture] = chart
    prompt: str = PROMPTS[0]
    position_m: tuple[float, float, float] = HOME_M
    quat_xyzw: tuple[float, float, float, float] = DOWN_XYZW
    width_m: float = MAX_WIDTH_M
    holding: bool = False
    swapped: bool = False
    active: bool = True
    strange: bool = False


def example_styles(prompts: Sequence[str] = PROMPTS) -> list[ExampleStyle]:
    """All examples, the most informative first."""
    first = prompts[0]
    return [
        ExampleStyle("colour chart", prompt=first),
        ExampleStyle("noise", picture=noise, prompt=first),
        ExampleStyle("black pictures", picture=plain(0), prompt=first),
        *(ExampleStyle(f"prompt {prompt[:24]!r}", prompt=prompt) for prompt in prompts[1:]),
        ExampleStyle("a strange prompt", prompt=STRANGE_PROMPT, strange=True),
        ExampleStyle("something held", prompt=first, width_m=0.03, holding=True),
        ExampleStyle("gripper shut", prompt=first, width_m=0.0, position_m=(0.5, 0.2, 0.02)),
        ExampleStyle("far corner", prompt=first, position_m=(0.75, -0.45, 0.6)),
        ExampleStyle("tool tilted", prompt=first, quat_xyzw=TILTED_XYZW),
        ExampleStyle("white pictures", picture=plain(255), prompt=first),
        ExampleStyle("not obeyed", prompt=first, active=False),
    ]


@dataclass(slots=True)
class ExampleMaker:
    """Makes observations, each a period later than the last.

    Args:
        profile: for image sizes and joints; None: defaults.
    """

    spec: ModelSpec
    profile: Profile | None = None
    seq: int = 0

    def make(self, style: ExampleStyle, *, again: bool = False) -> Observation:
        """An observation of this style, with read-only arrays as in a worker.

        Args:
            again: use the stamp and number of the first observation.

        Raises:
            SpecError: an image of the profile's size does not fit the spec.
        """
        seq = 0 if again else self.seq
        self.seq = max(self.seq, seq + 1)
        spec = self.spec
        seen = Observation(
            stamp_wall_ns=START_NS + seq * PERIOD_NS,
            seq=seq,
            task=Task(1, style.active, style.prompt, spec.name, rate_hz=5.0),
            images=self._images(style),
            depth=self._depth(style),
            privileged=PrivilegedState({}) if "privileged" in spec.observation.state else None,
        )
        if spec.parts == ("",):
            seen = replace(seen, **self._state(style, ""))
        else:
            parts = {part: replace(seen, **self._state(style, part)) for part in spec.parts}
            seen = replace(seen, parts=parts)
        # An arm that stood still and was looked at: earlier pictures are as this one.
        before = range(spec.observation.history - 1, 0, -1)
        spacing_ns = round((spec.observation.history_spacing_s or 0.0) * 1e9)
        stamps_ns = (seen.stamp_wall_ns - steps * spacing_ns for steps in before)
        return replace(seen, history=tuple(replace(seen, stamp_wall_ns=at) for at in stamps_ns))

    def _images(self, style: ExampleStyle) -> Mapping[str, Picture]:
        out: dict[str, Picture] = {}
        for camera in self.spec.observation.cameras:
            picture = style.picture(*self._size(camera))
            if style.swapped:
                picture = np.ascontiguousarray(picture[..., ::-1])
            prepared = np.array(prepare_image(Image(picture), camera))
            prepared.setflags(write=False)
            out[camera.camera] = prepared
        return out

    def _depth(self, style: ExampleStyle) -> Mapping[str, NDArray[np.uint16]]:
        """What is bright is near: from 0.3 to 1.3 m, and a border that was not measured."""
        out: dict[str, NDArray[np.uint16]] = {}
        for camera in self.spec.observation.depth:
            grey = style.picture(*self._size(camera)).mean(axis=2)
            depth_m = 1.3 - grey / 255.0
            depth_m[:, :UNMEASURED_PX] = 0.0
            source = self.profile.cameras.get(camera.camera) if self.profile else None
            unit_m = (source and source.depth_unit_m) or camera.unit_m
            prepared = prepare_depth(Depth.of_metres(depth_m, unit_m), camera)
            prepared.setflags(write=False)
            out[camera.camera] = prepared
        return out

    def _size(self, camera: CameraSpec | DepthSpec) -> tuple[int, int]:
        """Height and width of the camera's images."""
        source = self.profile.cameras.get(camera.camera) if self.profile else None
        if source is not None:
            return source.height, source.width
        if camera.resize == "none" and camera.height is not None and camera.width is not None:
            return camera.height, camera.width
        return DEFAULT_SIZE

    def _state(self, style: ExampleStyle, part: str) -> dict[str, Any]:
        """State of one arm, as far as the spec asks for it."""
        joint = self._joint(part)
        state: dict[str, Any] = {
            "joint": joint,
            "pose": PoseState(np.array(style.position_m), np.array(style.quat_xyzw), np.zeros(6)),
            "gripper": self._gripper(style, part),
            "wrench": np.zeros(6),
            "effort": joint.effort_nm,
        }
        asked = [name for name in self.spec.observation.state if name in state]
        return {FIELD_OF.get(name, name): state[name] for name in asked}

    def _gripper(self, style: ExampleStyle, part: str) -> GripperState:
        profile = self.profile
        if profile is None or part not in profile.part_names:
            width_m: float | None = style.width_m
        else:
            width_m = style.width_m if profile.of_part(part).robot.gripper is not None else None
        if width_m is None:
            return GripperState(None, moving=False, holding=False)
        return GripperState(width_m, moving=False, holding=style.holding)

    def _joint(self, part: str) -> JointState:
        # Those that the model moves, or seven made up.
        made_up = tuple(f"joint{number}" for number in range(1, 8))
        names = self.spec.action.of(part).joints or made_up
        position = np.zeros(len(names))
        if self.profile is not None and part in self.profile.part_names:
            robot = self.profile.of_part(part).robot
            names, position = robot.arm_joints, np.array(robot.home_rad)
        zeros = np.zeros(len(names))
        return JointState(names, position, zeros, zeros)


def example_observation(spec: ModelSpec, *, prompt: str = PROMPTS[0]) -> Observation:
    """A valid observation of the declared form: gray images, depth 0.8 m, an arm at rest."""
    style = ExampleStyle("gray pictures", plain(128), prompt, active=False)
    return ExampleMaker(spec).make(style)
