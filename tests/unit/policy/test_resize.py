"""A host without OpenCV shows a model the same pixels."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_zenoh.policy.resize import scaled, scaled_by_numpy

sides = st.integers(1, 80)


@given(old=st.tuples(sides, sides), new=st.tuples(sides, sides), seed=st.integers(0, 999))
@settings(max_examples=200)
def test_numpy_and_opencv_make_the_same_image_to_one_of_255_levels(
    old: tuple[int, int], new: tuple[int, int], seed: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (*old, 3), dtype=np.uint8)
    by_opencv, by_numpy = scaled(image, *new), scaled_by_numpy(image, *new)
    assert by_numpy.dtype == np.uint8
    np.testing.assert_allclose(by_numpy.astype(int), by_opencv, atol=1)
