"""What tests of recordings share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from chain import Chain

from vla_zenoh.lab.evaluation.result import Evaluation
from vla_zenoh.lab.recording.recorder import Recorder
from vla_zenoh.profile import Profile, override

RELATIVE = 1e-6  # stamps are floats of seconds since another beginning


def assert_same(one: Evaluation, other: Evaluation) -> None:
    """All figures."""
    a, b = one.row(), other.row()
    for name, value in a.items():
        if name == "record_id":
            continue
        if isinstance(value, float):
            assert math.isclose(value, b[name], rel_tol=RELATIVE, abs_tol=1e-9), name
        else:
            assert value == b[name], name
    for stage, values in one.stages_ms.items():
        np.testing.assert_array_equal(values, other.stages_ms[stage])
    assert [s.prompt for s in one.segments] == [s.prompt for s in other.segments]


@contextmanager
def recording(
    chain: Chain, path: Path, profile: Profile | None = None, name: str = "recorder"
) -> Iterator[Recorder]:
    recorder = Recorder(profile or chain.profile, chain.session, path, name=name).start()
    try:
        yield recorder
    finally:
        recorder.close()


def ghost_of(chain: Chain, name: str = "ghost") -> Profile:
    return override(chain.profile, {"robot": {"name": name}})
