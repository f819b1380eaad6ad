"""Grey levels and residual motion against plain numpy, loops and hand-made cases."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cable_rpc.edge.residual import analysis_grey, grey, motion_map, noise_threshold, residual_motion
from cable_rpc.edge.roi_config import RoiConfig

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 40))
SEEDS = st.integers(0, 2**32 - 1)
CLEANING_OFF = {"residual_noise_factor": 0.0, "residual_opening": False, "min_residual_area_px": 0}


def greys(size, seed, spread=60):
    """Two pictures that differ by up to ``spread`` levels, and where the second is defined."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, size)
    second = np.clip(first + rng.integers(-spread, spread + 1, size), 0, 255)
    return first.astype(np.uint8), second.astype(np.uint8), rng.random(size) < 0.8


def difference_of(first, second, valid):
    """E, with E = 0 where it is undefined."""
    return np.where(valid, np.abs(first.astype(int) - second.astype(int)), 0)


# --- analysis grid ------------------------------------------------------------------------------------


@given(size=SIZES, seed=SEEDS)
def test_scale_one_is_grey(size, seed):
    image = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    assert np.array_equal(analysis_grey(image, 1), grey(image))


def cells_of(image, scale):
    """float [rows, columns, scale, scale] luma, with the border's pixels repeated."""
    luma = grey(image).astype(np.float64)
    padded = np.pad(luma, ((0, -len(luma) % scale), (0, -luma.shape[1] % scale)), mode="edge")
    rows, columns = padded.shape[0] // scale, padded.shape[1] // scale
    return padded.reshape(rows, scale, columns, scale).swapaxes(1, 2)


@given(size=SIZES, seed=SEEDS, scale=st.sampled_from([3, 5, 7]))
def test_odd_scales_are_the_rounded_mean(size, seed, scale):
    image = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    # An odd number of levels has no mean halfway between two.
    expected = np.rint(cells_of(image, scale).mean(axis=(2, 3)))
    assert np.array_equal(analysis_grey(image, scale), expected)


@given(size=SIZES, seed=SEEDS, halvings=st.integers(1, 4))
def test_powers_of_two_round_at_each_halving(size, seed, halvings):
    image = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    scale = 2**halvings
    cells = cells_of(image, scale)
    exact = cells.mean(axis=(2, 3))
    for _ in range(halvings):
        quads = cells[..., ::2, ::2] + cells[..., 1::2, ::2] + cells[..., ::2, 1::2] + cells[..., 1::2, 1::2]
        cells = np.floor(quads / 4 + 0.5)
    small = analysis_grey(image, scale)
    assert small.shape == (-(-size[0] // scale), -(-size[1] // scale))
    assert np.array_equal(small, cells[..., 0, 0])
    assert np.abs(small - exact).max() <= 0.5 * halvings


def test_mixed_scale_stays_near_the_mean():
    image = np.random.default_rng(0).integers(0, 256, (37, 50, 3), dtype=np.uint8)
    assert np.abs(analysis_grey(image, 6) - cells_of(image, 6).mean(axis=(2, 3))).max() <= 1.0


def test_flat_pictures_stay_flat():
    for scale in (1, 2, 3, 4, 6, 8, 16):
        assert (analysis_grey(np.full((45, 61, 3), 93, np.uint8), scale) == 93).all()


# --- the paper's map ----------------------------------------------------------------------------------


@given(size=SIZES, seed=SEEDS, scale=st.sampled_from([1, 4]), threshold=st.integers(0, 60))
def test_paper_mode_is_the_equation(size, seed, scale, threshold):
    first, second, valid = greys(size, seed)
    config = RoiConfig.paper(residual_threshold_levels=threshold)
    expected = difference_of(first, second, valid) > threshold
    assert np.array_equal(motion_map(first, second, valid, config, scale), expected)
    assert np.array_equal(residual_motion(first, second, valid, threshold), expected)
    everywhere = difference_of(first, second, True) > threshold
    assert np.array_equal(motion_map(first, second, None, config, scale), everywhere)


def test_fractional_and_huge_thresholds():
    before, now = np.zeros((1, 4), np.uint8), np.array([[25, 26, 254, 255]], np.uint8)
    assert residual_motion(now, before, None, 25.9).tolist() == [[False, True, True, True]]
    assert residual_motion(now, before, None, 254).tolist() == [[False, False, False, True]]
    assert not residual_motion(now, before, None, 255).any()
    assert not residual_motion(now, before, None, 1e6).any()


def test_arguments_stay_as_they_are():
    first, second, valid = greys((20, 30), 5)
    before = first.copy(), second.copy(), valid.copy()
    motion_map(first, second, valid, RoiConfig(residual_blur=True), 1)
    assert all(np.array_equal(*pair) for pair in zip((first, second, valid), before, strict=True))


# --- noise --------------------------------------------------------------------------------------------


@given(size=SIZES, seed=SEEDS, spread=st.sampled_from([0, 3, 20, 90, 255]), factor=st.sampled_from([1.0, 3.5, 6.0]))
@settings(max_examples=200)
def test_threshold_is_numpys_median_of_deviations(size, seed, spread, factor):
    first, second, valid = greys(size, seed, spread)
    difference = difference_of(first, second, True).astype(np.uint8)
    for mask, levels in ((None, difference.ravel()), (valid, difference[valid])):
        expected = 10.0
        if levels.size:
            spread_of_noise = np.median(np.abs(levels - np.median(levels)))
            expected = max(10.0, factor * 1.4826 * spread_of_noise)
        assert noise_threshold(difference, mask, factor) == pytest.approx(expected, rel=1e-12)


def test_noise_alone_is_no_motion():
    rng = np.random.default_rng(1)
    still = np.full((200, 300), 128.0)
    noisy = [np.clip(np.rint(still + rng.normal(0, 8, still.shape)), 0, 255).astype(np.uint8) for _ in range(2)]
    # The threshold is 6 * 0.5917 = 3.55 standard deviations of the difference, which 0.04 % of noise exceeds.
    sigma = np.std(noisy[0].astype(float) - noisy[1])
    magnitudes = np.abs(noisy[0].astype(int) - noisy[1]).astype(np.uint8)
    assert noise_threshold(magnitudes, None, 6.0) == pytest.approx(3.55 * sigma, rel=0.15)
    fixed = motion_map(*noisy, None, RoiConfig(**CLEANING_OFF), 4)
    adaptive = motion_map(*noisy, None, RoiConfig(**CLEANING_OFF | {"residual_noise_factor": 6.0}), 4)
    assert fixed.mean() > 0.01
    assert adaptive.mean() < 1e-3


def test_faint_motion_on_a_clean_picture():
    before, now = np.full((40, 60), 100, np.uint8), np.full((40, 60), 100, np.uint8)
    now[10:20, 10:30] = 118
    assert not motion_map(now, before, None, RoiConfig.paper(), 4).any()
    assert motion_map(now, before, None, RoiConfig(), 4).sum() == 200


# --- cleaning -----------------------------------------------------------------------------------------


def any_3x3(mask):
    """True where one of the nine pixels around is, what lies outside the picture counting as nothing."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    windows = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.any(windows, axis=0)


def pieces(mask):
    """Lists of pixels that touch each other along sides or corners."""
    left = {(int(y), int(x)) for y, x in np.argwhere(mask)}
    while left:
        piece, queue = [], deque([left.pop()])
        while queue:
            y, x = queue.popleft()
            piece.append((y, x))
            near = {(y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)} & left
            left -= near
            queue.extend(near)
        yield piece


@given(size=SIZES, seed=SEEDS, density=st.sampled_from([0.1, 0.5, 0.9]))
def test_opening(size, seed, density):
    motion = np.random.default_rng(seed).random(size) < density
    now = np.where(motion, 255, 0).astype(np.uint8)
    config = RoiConfig(**CLEANING_OFF | {"residual_opening": True})
    expected = any_3x3(~any_3x3(~motion))
    assert np.array_equal(motion_map(now, np.zeros_like(now), None, config, 1), expected)
    assert np.array_equal(motion_map(now, np.zeros_like(now), None, config, 4), motion)


@given(size=SIZES, seed=SEEDS, area=st.sampled_from([0, 1, 2, 5, 16]), scale=st.sampled_from([1, 2, 4]))
def test_small_pieces_are_removed(size, seed, area, scale):
    motion = np.random.default_rng(seed).random(size) < 0.3
    now = np.where(motion, 255, 0).astype(np.uint8)
    config = RoiConfig(**CLEANING_OFF | {"min_residual_area_px": area})
    expected = np.zeros_like(motion)
    for piece in pieces(motion):
        if len(piece) * scale * scale >= area:
            expected[tuple(np.transpose(piece))] = True
    assert np.array_equal(motion_map(now, np.zeros_like(now), None, config, scale), expected)


@given(size=SIZES, seed=SEEDS)
def test_blur_is_a_mean_of_nine(size, seed):
    # Multiples of nine have whole means of nine.
    rng = np.random.default_rng(seed)
    first, second = (9 * rng.integers(0, 29, (2, *size))).astype(np.uint8)
    valid = rng.random(size) < 0.9

    def mean(picture):
        padded = np.pad(picture.astype(int), 1, mode="reflect" if min(size) > 1 else "edge")
        return sum(padded[y : y + size[0], x : x + size[1]] for y in range(3) for x in range(3)) // 9

    if min(size) > 1:
        config = RoiConfig(**CLEANING_OFF | {"residual_blur": True})
        expected = (np.abs(mean(first) - mean(second)) > 25) & ~any_3x3(~valid)
        assert np.array_equal(motion_map(first, second, valid, config, 1), expected)
        unblurred = difference_of(first, second, valid) > 25
        assert np.array_equal(motion_map(first, second, valid, config, 4), unblurred)
