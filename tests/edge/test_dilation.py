"""Dilation, gating and uncertainty growth against masks stamped pixel by pixel; block masks against theirs."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.edge.dilation import (
    dilate,
    dilation_radius,
    ellipse_rectangles,
    fuse,
    gated_dilation,
    grow_uncertain,
)
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import RoiMask

SIZES = st.tuples(st.integers(1, 30), st.integers(1, 150))


def random_mask(size, seed, density):
    return np.random.default_rng(seed).random(size) < density


MASKS = st.one_of(
    st.tuples(st.integers(1, 12), st.integers(1, 40)).flatmap(lambda size: hnp.arrays(np.bool_, size)),
    st.builds(random_mask, SIZES, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.002, 0.05, 0.5, 1.0])),
)


def stamped(mask, radius_px):
    """Every pixel replaced by an elliptic kernel around it."""
    radius = math.ceil(radius_px)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)).astype(bool)
    height, width = mask.shape
    canvas = np.zeros((height + 2 * radius, width + 2 * radius), np.bool_)
    for y, x in np.argwhere(mask):
        canvas[y : y + 2 * radius + 1, x : x + 2 * radius + 1] |= kernel
    return canvas[radius : radius + height, radius : radius + width]


@given(mask=MASKS, radius=st.one_of(st.integers(0, 40), st.floats(0, 40)))
@settings(max_examples=200, deadline=None)
def test_dilation_is_stamping(mask, radius):
    before = mask.copy()
    assert np.array_equal(dilate(mask, radius), stamped(mask, radius))
    assert np.array_equal(mask, before)


@given(mask=MASKS, radius=st.floats(0, 25), seed=st.integers(0, 999))
@settings(max_examples=150, deadline=None)
def test_gated_dilation_is_the_equation(mask, radius, seed):
    motion = np.random.default_rng(seed).random(mask.shape) < 0.4
    before = mask.copy(), motion.copy()
    raw = gated_dilation(mask, motion, radius)
    assert np.array_equal(raw, mask | (stamped(mask, radius) & motion))
    assert np.array_equal(raw, fuse(mask, dilate(mask, radius), motion))
    raw[:] = True
    assert (np.array_equal(mask, before[0]), np.array_equal(motion, before[1])) == (True, True)


@pytest.mark.parametrize("radius", [8, 13, 64, 200])
def test_dilation_of_a_road_scene(radius):
    rng = np.random.default_rng(radius)
    mask = np.zeros((225, 403), np.bool_)
    for _ in range(6):
        y, x, height, width = rng.integers([0, 0, 3, 3], [200, 380, 60, 80])
        mask[y : y + height, x : x + width] = True
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    assert np.array_equal(dilate(mask, radius), cv2.dilate(mask.view(np.uint8), kernel).astype(bool))


def test_strided_masks():
    rng = np.random.default_rng(3)
    mask, motion = rng.random((40, 90)) < 0.02, rng.random((40, 90)) < 0.5
    views = mask[::2, ::-1], motion[::2, ::-1]
    expected = stamped(np.ascontiguousarray(views[0]), 5)
    assert np.array_equal(dilate(views[0], 5), expected)
    assert np.array_equal(gated_dilation(*views, 5), views[0] | (expected & views[1]))


@pytest.mark.parametrize("radius", [1, 2, 7, 21, 30, 64, 99, 150, 333])
def test_kernel_is_opencvs(radius):
    built = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    for half_width, half_height in ellipse_rectangles(radius):
        built[radius - half_height : radius + half_height + 1, radius - half_width : radius + half_width + 1] = 1
    assert np.array_equal(built, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, built.shape))


@pytest.mark.parametrize("radius", [100, 1000, 1e300, math.inf])
def test_radius_beyond_the_frame(radius):
    mask = np.zeros((9, 20), np.bool_)
    assert not dilate(mask, radius).any()
    mask[0, 19] = True
    assert dilate(mask, radius).all()


# --- radius -------------------------------------------------------------------------------------------


def test_paper_radius_knows_no_camera_and_no_limit():
    paper = RoiConfig.paper()
    assert dilation_radius(paper, 0.0, 0.0, fx=1266.0, width=1600) == 8
    assert dilation_radius(paper, 0.0, -1.0, fx=1266.0, width=1600) == 28
    assert dilation_radius(paper, 1.5, 0.0, fx=1266.0, width=1600) == pytest.approx(10.25)
    assert dilation_radius(paper, 0.0, 90.0, fx=1266.0, width=1600) == 1808


def test_robust_radius_follows_the_focal_length():
    config = RoiConfig()
    # One degree moves the centre of the picture by the focal length times its tangent.
    assert dilation_radius(config, 0.0, 1.0, fx=1266.0, width=1600) == pytest.approx(
        8 + 1266 * math.tan(math.radians(1)), abs=0.01
    )
    assert dilation_radius(config, 0.0, 1.0, fx=None, width=1600) == 28
    assert dilation_radius(config, 0.0, 45.0, fx=1266.0, width=1600) == 80
    assert dilation_radius(config, 0.0, 45.0, fx=1266.0) == pytest.approx(8 + 1266 * math.pi / 4)


# --- uncertainty --------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    scale=st.sampled_from([1, 3, 4]),
    max_radius=st.sampled_from([0.0, 5.0, 16.0]),
    density=st.sampled_from([0.0, 0.01, 0.2]),
)
@settings(max_examples=150, deadline=None)
def test_uncertain_pixels_join_with_their_margin(seed, size, scale, max_radius, density):
    rng = np.random.default_rng(seed)
    uncertainty = np.where(rng.random(size) < density, rng.integers(0, 256, size), 0).astype(np.uint8)
    cells = rng.random((-(-size[0] // scale), -(-size[1] // scale))) < 0.1
    expected = cells.copy()
    for y, x in np.argwhere(uncertainty):
        level = 85 * round(float(uncertainty[y, x]) / 85)
        if level:
            alone = np.zeros(cells.shape, np.bool_)
            alone[y // scale, x // scale] = True
            expected |= stamped(alone, max_radius * level / 255 / scale)
    before = cells.copy()
    assert np.array_equal(grow_uncertain(cells, uncertainty, scale, max_radius), expected)
    assert np.array_equal(cells, before)


def test_margin_grows_with_the_uncertainty():
    reached = []
    for level in (0, 42, 43, 85, 127, 128, 170, 213, 255):
        uncertainty = np.zeros((41, 41), np.uint8)
        uncertainty[20, 20] = level
        grown = grow_uncertain(np.zeros((41, 41), np.bool_), uncertainty, 1, 15.0)
        reached.append(-1 if not grown.any() else int(np.nonzero(grown)[1].max()) - 20)
    assert reached == [-1, -1, 5, 5, 5, 10, 10, 15, 15]


# --- block masks --------------------------------------------------------------------------------------


@given(
    mask=st.builds(
        random_mask,
        st.tuples(st.integers(1, 50), st.integers(1, 50)),
        st.integers(0, 2**32 - 1),
        st.sampled_from([0.0, 0.01, 0.3, 1.0]),
    ),
    block_size=st.one_of(st.sampled_from([1, 4, 8, 16]), st.integers(1, 60)),
)
@settings(max_examples=200, deadline=None)
def test_block_masks(mask, block_size):
    height, width = mask.shape
    rows, columns = -(-height // block_size), -(-width // block_size)
    expected = np.array(
        [
            [mask[y : y + block_size, x : x + block_size].any() for x in range(0, width, block_size)]
            for y in range(0, height, block_size)
        ]
    )
    for view in (mask, np.asfortranarray(mask)):
        roi = RoiMask.from_pixels(view, block_size)
        assert roi.blocks.shape == (rows, columns)
        assert np.array_equal(roi.blocks, expected)
    pixels = np.array([[expected[y // block_size, x // block_size] for x in range(width)] for y in range(height)])
    roi = RoiMask(np.asfortranarray(expected), block_size, height, width)
    assert roi.pixels().dtype == np.bool_
    assert np.array_equal(roi.pixels(), pixels)
    assert roi.coverage == pixels.mean()


def test_block_mask_does_not_share_the_pixels():
    mask = np.zeros((4, 4), np.bool_)
    roi = RoiMask.from_pixels(mask, 1)
    mask[:] = True
    assert not roi.blocks.any()
