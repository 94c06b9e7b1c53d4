"""In which sizes living models want the pictures of a camera, by their specs."""

from __future__ import annotations

from vla_zenoh.policy import CameraSpec, ModelSpec
from vla_zenoh.policy.observation import form_of

SILENCE_S = 5.0
"""A worker says its spec once a second; one that was silent for so long is gone."""
MAX_MODELS = 64


class RequestedSizes:
    """The newest spec of each worker, so that each of them asks for one size of a camera."""

    def __init__(self) -> None:
        self._specs: dict[str, tuple[float, ModelSpec]] = {}

    def hear(self, worker: str, spec: ModelSpec, now_s: float) -> bool:
        """Take a spec; False where there are too many already.

        Args:
            worker: whose it is, by its key.
            spec: what it says.
            now_s: any clock that only goes up.
        """
        self._forget(now_s)
        if worker not in self._specs and len(self._specs) >= MAX_MODELS:
            return False
        self._specs[worker] = (now_s, spec)
        return True

    def sizes(self, camera: str, now_s: float) -> dict[str, CameraSpec]:
        """Form -> what the model that asked for it said of it; who asked first comes first."""
        self._forget(now_s)
        wanted = (
            one
            for _, spec in self._specs.values()
            for one in spec.observation.cameras
            if one.camera == camera
        )
        forms = ((form_of(one), one) for one in wanted)
        return {form: one for form, one in forms if form is not None}

    def _forget(self, now_s: float) -> None:
        for worker, (heard_s, _) in list(self._specs.items()):
            if now_s - heard_s > SILENCE_S:
                del self._specs[worker]
