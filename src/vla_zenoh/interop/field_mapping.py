"""How a policy server's names and numbers stand to ours: what it is sent, what its answer means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.interop.action_semantics import ActionSemantics
from vla_zenoh.interop.joints import Forward
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation
from vla_zenoh.policy.state_vector import state_vector
from vla_zenoh.types import shown


@dataclass(frozen=True, slots=True)
class FieldSource:
    """What one of the server's names is filled with.

    Args:
        camera: a picture of this camera, or empty.
        parts: of the state, may be none.
        prompt: the prompt.
        blank: height and width of a black picture.
    """

    camera: str = ""
    parts: tuple[str, ...] = ()
    prompt: bool = False
    blank: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class FieldMapping:
    """See the module. Made by `read_field_mapping`.

    Args:
        fields: the server's name -> what it is filled with.
        spec: what our side is told.
        keys: names in the answer.
        columns: of the answer, None: all.
        meaning: of its numbers.
        max_width_m: of our gripper.
    """

    fields: Mapping[str, FieldSource]
    spec: ModelSpec
    keys: tuple[str, ...]
    columns: tuple[int, ...] | None
    semantics: ActionSemantics
    max_width_m: float

    @property
    def width(self) -> int | None:
        """Columns of an answer, None where only the arm knows how many joints it has."""
        if self.columns is not None:
            return len(self.columns)
        return None if self.semantics.needs_joints else sum(self.semantics.parts(0).values())

    # -- out ----------------------------------------------------------------------------------
    def request(self, observation: Observation) -> dict[str, Any]:
        """The server's names with pictures (H, W, 3) uint8, numbers (n,) float32 and text."""
        out: dict[str, Any] = {}
        for theirs, source in self.fields.items():
            if source.camera:
                out[theirs] = observation.images[source.camera]
            elif source.blank:
                out[theirs] = np.zeros((*source.blank, 3), np.uint8)
            elif source.prompt:
                out[theirs] = observation.prompt
            else:
                out[theirs] = state_vector(source.parts, observation, self.max_width_m)
        return out

    # -- in -----------------------------------------------------------------------------------
    def gather(self, answer: Any) -> NDArray[np.float64]:
        """(H, C) of an answer: an array, or a map of arrays under `keys`.

        Raises:
            PeerError: names are missing, shapes do not go together, or a number is not finite.
        """
        if isinstance(answer, Mapping):
            missing = [key for key in self.keys if key not in answer]
            if missing:
                raise PeerError(
                    "peer_reply",
                    f"the answer has no {', '.join(map(repr, missing))}; it has: "
                    + ", ".join(map(str, list(answer)[:20])),
                )
            parts = [_matrix(key, answer[key], len(self.keys) > 1) for key in self.keys]
        else:
            parts = [_matrix("actions", answer, False)]
        if len({len(part) for part in parts}) != 1:
            counts = ", ".join(f"{k} {len(p)}" for k, p in zip(self.keys, parts, strict=True))
            raise PeerError("peer_reply", f"parts of the answer differ in their steps: {counts}")
        rows = np.concatenate(parts, axis=1)
        if self.columns is not None:
            if max(self.columns) >= rows.shape[1]:
                raise PeerError(
                    "peer_reply",
                    f"the answer has {rows.shape[1]} columns, column {max(self.columns)} is wanted",
                )
            rows = rows[:, list(self.columns)]
        if len(rows) == 0:
            raise PeerError("peer_reply", "the answer has no steps")
        if not np.isfinite(rows).all():
            raise PeerError("peer_reply", "the answer holds NaN or infinity")
        return rows[: self.spec.action.horizon]

    def read(
        self, answer: Any, observation: Observation, forward: Forward | None = None
    ) -> ActionSteps:
        """`steps`, and what the server said for people who look at it."""
        said = self.gather(answer)[0].tolist()
        return ActionSteps(self.steps(answer, observation, forward), raw={"first_step": said})

    def steps(
        self, answer: Any, observation: Observation, forward: Forward | None = None
    ) -> NDArray[np.float64]:
        """(H, D) in the meaning of `spec`.

        Args:
            answer: see `gather`.
            observation: what was asked about: where joint deltas begin.
            forward: kinematics, where the answers are joints.

        Raises:
            PeerError: see `gather`; also another number of columns.
        """
        rows = self.gather(answer)
        try:
            return self.semantics.steps(rows, observation.joint, forward)
        except SpecError as error:
            hint = "; choose them with columns=" if error.reason == "shape" else ""
            raise PeerError("peer_reply", f"{error}{hint}") from error


def _matrix(name: str, value: Any, named: bool) -> NDArray[np.float64]:
    """(H, C); a batch of one is unpacked. One row of numbers is H single ones if it is `named`."""
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError, TypeError) as error:
        raise PeerError("peer_reply", f"{name} is not a table of numbers: {error}") from error
    if array.dtype.kind not in "iuf":
        raise PeerError("peer_reply", f"{name} is not numbers but {shown(value)}")
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 1:
        array = array[:, None] if named else array[None]
    if array.ndim != 2:
        raise PeerError("peer_reply", f"{name} has shape {array.shape}, wanted (H, D)")
    return array.astype(np.float64)
