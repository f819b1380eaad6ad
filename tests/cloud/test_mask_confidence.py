"""Confidence and doubt from logits, against the definitions written out pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.cloud.mask_confidence import mask_confidence, uncertainty_of, united_logits

logit_maps = hnp.arrays(np.float32, (5, 7), elements=st.floats(-40, 40, width=32))
regions = hnp.arrays(np.bool_, (5, 7))


def probability(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-logit))


@given(hnp.arrays(np.float32, (3, 4, 5), elements=st.floats(-9, 9, width=32)))
def test_the_union_of_the_masks_is_the_mask_of_the_united_logits(logits: np.ndarray) -> None:
    assert np.array_equal(united_logits(logits) > 0, (logits > 0).any(axis=0))
    assert np.array_equal(united_logits(logits[:1]), logits[0])


@given(logit_maps, regions)
@example(np.full((5, 7), -0.01, np.float32), np.ones((5, 7), np.bool_))
def test_confidence_is_the_mean_probability_of_the_mask_or_of_its_absence(
    logits: np.ndarray, region: np.ndarray
) -> None:
    inside = [float(logits[y, x]) for y in range(5) for x in range(7) if region[y, x]]
    found = [probability(logit) for logit in inside if logit > 0]
    empty = 1.0 - max((probability(logit) for logit in inside), default=0.0)
    expected = sum(found) / len(found) if found else empty
    confidence = mask_confidence(logits, region)
    assert math.isclose(confidence, expected, rel_tol=1e-9)
    assert 0.5 <= confidence <= 1.0


def test_confidence_does_not_jump_where_the_last_pixel_goes() -> None:
    logits = np.full((5, 7), -30.0, np.float32)
    whole = np.ones((5, 7), np.bool_)
    logits[2, 3] = 1e-4
    with_it = mask_confidence(logits, whole)
    logits[2, 3] = -1e-4
    assert abs(mask_confidence(logits, whole) - with_it) < 1e-3


@given(logit_maps)
def test_doubt_is_full_at_the_border_and_none_beyond_the_band(logits: np.ndarray) -> None:
    uncertainty = uncertainty_of(logits)
    assert uncertainty.dtype == np.uint8
    for y in range(5):
        for x in range(7):
            p = probability(float(logits[y, x]))
            expected = 255 * 4 * p * (1 - p)
            if abs(logits[y, x]) < 2.99:
                assert abs(int(uncertainty[y, x]) - expected) <= 1.1
            elif abs(logits[y, x]) >= 3:
                assert uncertainty[y, x] == 0


def test_the_faintest_doubt_is_more_than_half_a_level_of_the_wire() -> None:
    logits = np.array([[0.0, 2.99, -2.99, 3.0, -32.0, np.inf]], np.float32)
    assert uncertainty_of(logits).tolist() == [[255, 47, 47, 0, 0, 0]]
