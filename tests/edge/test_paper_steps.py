"""The steps of the paper's method: its reference checks, against literal references and hand-made cases."""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

sys.path.insert(0, str(Path(__file__).parent))

import algorithm1_reference as reference

from cable_rpc.edge.corridor import corridor, corridor_curves, moving_average
from cable_rpc.edge.dilation import dilate, dilation_radius, ellipse_rectangles, fuse
from cable_rpc.edge.refresh import mask_iou, refresh_flag
from cable_rpc.edge.residual import grey, residual_motion
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.view_warp import ViewWarp, warp_frame
from cable_rpc.errors import ConfigurationError

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 40))
MASKS = SIZES.flatmap(lambda size: hnp.arrays(np.bool_, size))
SPARSE_MASKS = st.tuples(SIZES, st.integers(0, 2**32 - 1), st.floats(0, 0.2)).map(
    lambda t: np.random.default_rng(t[1]).random(t[0]) < t[2]
)


def translation(shift):
    homography = np.eye(3)
    homography[0, 2] = shift
    return homography


# --- settings -----------------------------------------------------------------------------------------


def test_defaults_are_the_papers():
    config = RoiConfig.paper()
    assert config.mode == "paper"
    assert (config.residual_threshold_levels, config.min_coverage, config.min_iou) == (25, 0.02, 0.3)
    assert (config.smoothing_window_columns, config.top_margin, config.bottom_margin) == (15, 0.10, 0.15)
    assert (config.min_height_fraction, config.dilation_base_px) == (0.1, 8)
    assert (config.dilation_per_metre_px, config.dilation_per_degree_px, config.epsilon_m) == (1.5, 20, 1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("ego_model", "bold"),
        ("keyframe_policy", "often"),
        ("min_iou", 1.5),
        ("smoothing_window_columns", 14),
        ("dilation_base_px", -1.0),
        ("dilation_per_metre_px", float("nan")),
        ("epsilon_m", 0.0),
        ("stale_after_s", -1.0),
    ],
)
def test_unusable_setting_is_named(field, value):
    with pytest.raises(ConfigurationError, match=field):
        RoiConfig.paper(**{field: value})


# --- residual -----------------------------------------------------------------------------------------


def test_grey_is_bt601():
    image = np.random.default_rng(1).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    luma = image.astype(float) @ [0.114, 0.587, 0.299]
    assert np.abs(grey(image) - luma).max() <= 0.51


def test_threshold_is_strict_and_symmetric():
    before = np.full((1, 4), 100, np.uint8)
    now = np.array([[125, 126, 75, 74]], np.uint8)
    assert residual_motion(now, before, None, 25).tolist() == [[False, True, False, True]]


def test_no_motion_where_the_warp_is_undefined():
    still = np.full((6, 30), 200, np.uint8)
    warped, valid = warp_frame(still, ViewWarp(translation(7.5)))
    assert not residual_motion(still, warped, valid, 25).any()
    assert residual_motion(still, warped, None, 25)[:, :7].all()


# --- dilation and fusion ------------------------------------------------------------------------------


def test_one_degree_adds_twenty_pixels():
    config = RoiConfig.paper()
    assert dilation_radius(config, 0.0, 0.0) == 8
    assert dilation_radius(config, 0.0, 1.0) == 28
    assert dilation_radius(config, 0.0, -1.0) == 28
    assert dilation_radius(config, 1.5, 0.0) == pytest.approx(10.25)


@pytest.mark.parametrize("radius", [*range(20), 33, 50])
def test_nested_rectangles_make_the_ellipse(radius):
    built = np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8)
    for half_width, half_height in ellipse_rectangles(radius):
        built[radius - half_height : radius + half_height + 1, radius - half_width : radius + half_width + 1] = 1
    assert np.array_equal(built, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, built.shape))


@given(mask=st.one_of(MASKS, SPARSE_MASKS), radius=st.floats(0, 20))
@settings(max_examples=200)
def test_dilation_equals_elliptic_kernel(mask, radius):
    size = 2 * int(np.ceil(radius)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    expected = cv2.dilate(mask.view(np.uint8), kernel).view(np.bool_)
    assert np.array_equal(dilate(mask, radius), expected)


def test_dilation_equals_stamped_discs():
    mask = np.random.default_rng(5).random((48, 64)) < 0.01
    for radius in (0, 0.2, 3, 8, 11.3):
        assert np.array_equal(dilate(mask, radius), reference.dilate(mask, radius))


def test_dilation_leaves_its_argument_alone():
    mask = np.zeros((20, 20), np.bool_)
    mask[10, 10] = True
    for radius in (0, 4, 1e9, 1e300):
        dilate(mask, radius)[:] = True
        assert mask.sum() == 1


def test_huge_dilation_covers_the_frame():
    mask = np.zeros((20, 20), np.bool_)
    assert not dilate(mask, 1e300).any()
    mask[0, 0] = True
    assert dilate(mask, 1e300).all()


@given(seed=st.integers(0, 999))
def test_fusion_formula(seed):
    warped, dilated, motion = np.random.default_rng(seed).random((3, 9, 11)) < 0.4
    assert np.array_equal(fuse(warped, dilated, motion), warped | (dilated & motion))


# --- corridor -----------------------------------------------------------------------------------------


def test_corridor_on_the_papers_blob():
    raw = np.zeros((720, 1280), np.bool_)
    raw[300:341, 600:640] = True
    band = corridor(raw, RoiConfig.paper())
    rows, columns = np.nonzero(band)
    assert (columns.min(), columns.max()) == (600, 639)
    assert (rows.min(), rows.max()) == (270, 397)
    assert band[270:398, 600:640].all()


def test_two_blobs_make_one_band():
    raw = np.zeros((720, 1280), np.bool_)
    raw[300:341, 200:240] = True
    raw[350:391, 540:580] = True
    band = corridor(raw, RoiConfig.paper())
    assert band.any(axis=0)[200:580].all()
    assert not band.any(axis=0)[:200].any()
    assert not band.any(axis=0)[580:].any()


def test_smoothing_does_not_bend_at_the_ends():
    assert moving_average(np.full(40, 300.0), 15) == pytest.approx(np.full(40, 300.0))
    raw = np.zeros((400, 500), np.bool_)
    raw[200:221, :] = True
    _, first, last = corridor_curves(raw, RoiConfig.paper())
    assert len(set(first)) == len(set(last)) == 1


@pytest.mark.parametrize("row", [0, 3, 50, 96, 99])
def test_least_height_stays_inside(row):
    raw = np.zeros((100, 40), np.bool_)
    raw[row, 10:30] = True
    config = RoiConfig.paper(top_margin=0, bottom_margin=0, min_height_fraction=0.2)
    rows = np.nonzero(corridor(raw, config))[0]
    assert rows.max() - rows.min() == 20
    centre = min(max(row, 10), 89)
    assert rows.min() == centre - 10


def test_least_height_of_the_whole_frame():
    raw = np.zeros((30, 8), np.bool_)
    raw[29, 2:5] = True
    assert corridor(raw, RoiConfig.paper(min_height_fraction=1.0))[:, 2:5].all()


def test_empty_stays_empty():
    assert not corridor(np.zeros((30, 40), np.bool_), RoiConfig.paper()).any()


@given(
    mask=st.one_of(MASKS, SPARSE_MASKS),
    window=st.sampled_from([1, 3, 15, 51]),
    margins=st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(0, 100)),
)
@settings(max_examples=150, deadline=None)
def test_corridor_equals_exact_fractions(mask, window, margins):
    top, bottom, least = (Fraction(value, 100) for value in margins)
    config = RoiConfig.paper(
        smoothing_window_columns=window,
        top_margin=float(top),
        bottom_margin=float(bottom),
        min_height_fraction=float(least),
    )
    expected = reference.corridor(mask, {"w_s": window, "eta_t": top, "eta_b": bottom, "h_min": least})
    region = corridor(mask, config)
    assert np.array_equal(region, expected)
    assert not (mask & ~region).any()


# --- refresh ------------------------------------------------------------------------------------------


def test_refresh_flag_is_the_equation():
    config = RoiConfig.paper()
    assert not refresh_flag(0.02, 0.3, config)
    assert refresh_flag(0.0199, 1.0, config)
    assert refresh_flag(0.5, 0.299, config)
    assert refresh_flag(0.0, None, config)
    assert not refresh_flag(0.5, None, config)
    assert not refresh_flag(None, None, config)


def test_iou_of_two_empty_masks_counts_as_lost():
    empty, full = np.zeros((4, 4), np.bool_), np.ones((4, 4), np.bool_)
    assert mask_iou(empty, empty) == 0
    assert mask_iou(full, empty) == 0
    assert mask_iou(full, full) == 1
