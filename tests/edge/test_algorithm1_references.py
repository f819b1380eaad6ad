"""The two literal Algorithms 1, one of pixel loops and fractions and one of NumPy, hold each other to account."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))

import algorithm1_numpy as vectorised
import algorithm1_reference as loops

from cable_rpc.edge.residual import grey
from cable_rpc.types import EgoMotion

SIZES = st.tuples(st.integers(1, 16), st.integers(1, 24))
SEEDS = st.integers(0, 2**32 - 1)
DENSITIES = st.sampled_from([0.0, 0.03, 0.4, 1.0])


@given(size=SIZES, seed=SEEDS, quarter=st.integers(-110, 110), tau_e=st.sampled_from([0, 25, 60]))
def test_warp_and_residual(size, seed, quarter, tau_e):
    rng = np.random.default_rng(seed)
    shift = quarter / 4
    mask = rng.random(size) < 0.5
    now, before = (4 * rng.integers(0, 64, (2, *size))).astype(np.float64)
    assert np.array_equal(vectorised.warp_mask(mask, shift), loops.warp_mask(mask, shift))
    warped, valid = vectorised.warp_grey(before, shift)
    expected, expected_valid = loops.warp_grey(before, shift)
    assert np.array_equal(valid, expected_valid)
    assert np.array_equal(warped, expected)
    motion = vectorised.residual(now, warped, valid, tau_e)
    assert np.array_equal(motion, loops.residual(now, expected, valid, tau_e))


@given(size=SIZES, seed=SEEDS, density=DENSITIES, radius=st.floats(0, 14))
@settings(deadline=None)
def test_dilation(size, seed, density, radius):
    mask = np.random.default_rng(seed).random(size) < density
    assert np.array_equal(vectorised.dilate(mask, radius), loops.dilate(mask, radius))


@given(
    size=SIZES,
    seed=SEEDS,
    density=DENSITIES,
    window=st.sampled_from([1, 3, 15]),
    margins=st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(0, 100)),
)
@settings(deadline=None)
def test_corridor(size, seed, density, window, margins):
    raw = np.random.default_rng(seed).random(size) < density
    top, bottom, least = (Fraction(value, 100) for value in margins)
    parameters = {"w_s": window, "eta_t": top, "eta_b": bottom, "h_min": least}
    assert np.array_equal(vectorised.corridor(raw, parameters), loops.corridor(raw, parameters))


@pytest.mark.parametrize("seed", range(8))
def test_whole_loop(seed):
    rng = np.random.default_rng(seed)
    height, width, count = 20, 32, 8
    greys = list((4 * rng.integers(8, 24, (count, height, width))).astype(np.uint8))
    masks = []
    left = int(rng.integers(0, 20))
    for picture in greys:
        left = int(np.clip(left + rng.integers(-5, 6), 0, 24))
        mask = np.zeros((height, width), np.bool_)
        mask[6:12, left : left + 8] = rng.random() < 0.9
        picture[mask] = 220
        masks.append(mask)
    egos = [EgoMotion(4.0, int(rng.integers(-6, 7)) / 16, float(rng.normal(0, 0.02))) for _ in range(count)]
    parameters = {**loops.PAPER, "b_0": 2.0}

    def cloud(k, region):
        return masks[k] if region is None else masks[k] & region

    both = [module.algorithm1(greys, egos, 16.0, 0.125, cloud, parameters) for module in (loops, vectorised)]
    keyframes = []
    for one, other in zip(*both, strict=True):
        assert one[:2] == other[:2]
        assert np.array_equal(one[2], other[2])
        assert np.array_equal(one[3], other[3])
        assert one[4] == pytest.approx(other[4])
        keyframes.append(one[1])
    assert len(keyframes) == count - 1


def test_grey_is_the_packages_up_to_rounding():
    image = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    difference = np.abs(vectorised.grey(image) - grey(image))
    assert difference.max() <= 1
    assert difference.mean() < 0.01
