"""Warps of masks and frames against loops over pixels and hand-made cases."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

sys.path.insert(0, str(Path(__file__).parent))

import algorithm1_reference as reference

from cable_rpc.edge.actor_warp import pieces, warp_actors
from cable_rpc.edge.ego_motion import ego_step
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.view_warp import MAX_MAGNIFICATION, ViewWarp, warp_frame, warp_mask
from cable_rpc.types import CameraIntrinsics, CameraMount, EgoMotion

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 40))
MASKS = SIZES.flatmap(lambda size: hnp.arrays(np.bool_, size))
CAMERA = CameraIntrinsics(60.0, 60.0, 39.5, 22.0)
MOUNT = CameraMount(1.5, 0.03)


def shift(pixels):
    homography = np.eye(3)
    homography[0, 2] = pixels
    return ViewWarp(homography)


def road_warp(speed, yaw_rate, dt=0.1):
    return ego_step(EgoMotion(speed, 0.0, yaw_rate), CAMERA, MOUNT, dt, RoiConfig(), 80).warp


def source_of(warp, x, y):
    """Source position of a destination pixel and its ratio of depths, solved anew for each pixel."""
    homography = warp.far if warp.far is not None and y < warp.horizon_row else warp.ground
    u, v, w = np.linalg.solve(homography, (x, y, 1.0))
    return (u / w, v / w, w) if w != 0 else (np.inf, np.inf, w)


@pytest.mark.parametrize("pixels", [np.inf, -np.inf, np.nan, 1e300, -1e300, 41.0, -41.0])
def test_shift_beyond_the_frame_empties_it(pixels):
    mask = np.ones((12, 40), np.bool_)
    image = np.full((12, 40), 99, np.uint8)
    assert not warp_mask(mask, shift(pixels)).any()
    assert not warp_frame(image, shift(pixels))[1].any()


@given(mask=MASKS, quarter=st.integers(-200, 200))
def test_warp_mask_is_nearest(mask, quarter):
    assert np.array_equal(warp_mask(mask, shift(quarter / 4)), reference.warp_mask(mask, quarter / 4))


@given(size=SIZES, quarter=st.integers(-200, 200), seed=st.integers(0, 999))
def test_warp_frame_is_bilinear(size, quarter, seed):
    image = (4 * np.random.default_rng(seed).integers(0, 64, size)).astype(np.uint8)
    warped, valid = warp_frame(image, shift(quarter / 4))
    valid = np.ones(size, np.bool_) if valid is None else valid
    expected, expected_valid = reference.warp_grey(image, quarter / 4)
    assert np.array_equal(valid, expected_valid)
    assert np.array_equal(warped[valid], expected[valid])


@pytest.mark.parametrize("warp", [ViewWarp(), ViewWarp(np.eye(3), np.eye(3), 7.0)])
def test_identity_copies_nothing(warp):
    mask, image = np.ones((4, 4), np.bool_), np.ones((4, 4), np.uint8)
    assert warp_mask(mask, warp) is mask
    assert warp_actors(mask, warp) is mask
    warped, valid = warp_frame(image, warp)
    assert warped is image
    assert valid is None


def test_general_homography_maps_forward():
    zoom = ViewWarp(np.array([[2.0, 0, -20], [0, 2.0, -10], [0, 0, 1]]))
    mask = np.zeros((20, 40), np.bool_)
    mask[8:12, 18:22] = True
    rows, columns = np.nonzero(warp_mask(mask, zoom))
    # Outermost source pixels land on rows 6 and 12 and columns 16 and 22; a pixel is two wide now.
    assert (abs(rows.min() - 6) <= 1, abs(rows.max() - 12) <= 1) == (True, True)
    assert (abs(columns.min() - 16) <= 1, abs(columns.max() - 22) <= 1) == (True, True)
    ramp = np.tile(np.arange(0, 200, 5, dtype=np.uint8), (20, 1))
    warped, valid = warp_frame(ramp, zoom)
    assert valid.all()
    assert abs(int(warped[10, 20]) - 100) <= 1
    assert abs(int(warped[10, 22]) - 105) <= 1


@pytest.mark.parametrize("homography", [np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1, np.nan])])
def test_what_has_no_inverse_leaves_nothing(homography):
    mask, image = np.ones((6, 8), np.bool_), np.ones((6, 8), np.uint8)
    assert not warp_mask(mask, ViewWarp(homography)).any()
    assert not warp_frame(image, ViewWarp(homography))[1].any()


@given(
    speed=st.floats(-40, 40),
    yaw_rate=st.floats(-6, 6),
    seed=st.integers(0, 999),
)
@settings(deadline=None, max_examples=12)
def test_road_warp_equals_a_loop_over_pixels(speed, yaw_rate, seed):
    warp = road_warp(speed, yaw_rate)
    rng = np.random.default_rng(seed)
    mask = np.zeros((45, 80), np.bool_)
    for y, x in rng.integers(0, (40, 70), (3, 2)):
        mask[y : y + 5, x : x + 10] = True
    image = np.broadcast_to(np.linspace(0, 200, 80) + np.linspace(0, 50, 45)[:, None], mask.shape).astype(np.uint8)
    warped_mask = warp_mask(mask, warp)
    warped, valid = warp_frame(image, warp)
    valid = np.ones(mask.shape, np.bool_) if valid is None else valid
    for y in range(45):
        for x in range(80):
            u, v, ratio = source_of(warp, x, y)
            seen = 0 < ratio <= MAX_MAGNIFICATION
            # Rounding decides at half pixels, borders and the limit itself; leave those out.
            if min(abs(ratio), abs(ratio - MAX_MAGNIFICATION)) < 1e-6:
                continue
            if min(abs(u % 1 - 0.5), abs(v % 1 - 0.5)) > 0.04:
                inside = seen and -0.5 <= u < 79.5 and -0.5 <= v < 44.5
                assert warped_mask[y, x] == (inside and mask[round(v), round(u)])
            if min(abs(u), abs(u - 79), abs(v), abs(v - 44)) > 1e-4:
                assert valid[y, x] == (seen and 0 <= u <= 79 and 0 <= v <= 44)
                if valid[y, x]:
                    assert abs(warped[y, x] - (u * 200 / 79 + v * 50 / 44)) < 3


def test_reversing_shows_nothing_of_what_was_behind_the_camera():
    warp = road_warp(-50.0, 0.0)
    warped, valid = warp_frame(np.full((45, 80), 200, np.uint8), warp)
    horizon = int(np.ceil(warp.horizon_row))
    # 5 m back: the road nearer than that lay behind the camera, and its mirror image above the horizon.
    assert not valid[44].any()
    assert not warp_mask(np.ones((45, 80), np.bool_), warp)[44].any()
    assert valid[:horizon].all()
    assert (warped[:horizon] == 200).all()


def test_scaled_warp_moves_the_same_points():
    warp = road_warp(10.0, 0.3)
    small = warp.scaled(0.25)
    for x, y in ((3.0, 40.0), (70.0, 30.0)):
        u, v, w = warp.ground @ (x, y, 1)
        a, b, c = small.ground @ ((x + 0.5) / 4 - 0.5, (y + 0.5) / 4 - 0.5, 1)
        assert (a / c, b / c) == pytest.approx(((u / w + 0.5) / 4 - 0.5, (v / w + 0.5) / 4 - 0.5))
    assert small.horizon_row == pytest.approx((warp.horizon_row + 0.5) / 4 - 0.5)
    assert warp.scaled(1) is warp
    assert shift(10.0).scaled(0.25).ground[0, 2] == 2.5
    assert ViewWarp().scaled(0.25).is_identity


def test_plain_and_split_warps_compose():
    road, plain = road_warp(10.0, 0.3), shift(2.0)
    for both, far in ((road.then(plain), plain.ground @ road.far), (plain.then(road), road.far @ plain.ground)):
        assert np.array_equal(both.far, far)
        assert both.horizon_row == road.horizon_row
    assert plain.then(plain).far is None
    assert plain.then(plain).ground[0, 2] == 4.0


# --- actors -------------------------------------------------------------------------------------------


def board(ahead_m, width_m=2.0, height_m=1.8):
    """Mask of an upright board across the road, its middle straight ahead of a level 320x180 camera 1.5 m up."""
    mask = np.zeros((180, 320), np.bool_)
    x = 160 + 240 * np.array([-width_m / 2, width_m / 2]) / ahead_m
    y = 90 + 240 * np.array([1.5 - height_m, 1.5]) / ahead_m
    mask[round(y[0]) : round(y[1]), round(x[0]) : round(x[1])] = True
    return mask


def test_upright_board_keeps_its_shape():
    camera, mount = CameraIntrinsics(240.0, 240.0, 159.5, 89.5), CameraMount(1.5)
    warp = ego_step(EgoMotion(20.0), camera, mount, 0.1, RoiConfig(), 320).warp
    before, after = board(12.0), board(10.0)
    predicted = warp_actors(before, warp)
    assert (predicted & after).sum() / (predicted | after).sum() > 0.9
    flat = warp_mask(before, warp)
    assert (flat & after).sum() / (flat | after).sum() < 0.9


def test_actors_move_apart_by_their_distance():
    warp = road_warp(12.0, 0.0)
    mask = np.zeros((45, 80), np.bool_)
    mask[20:24, 50:53] = True  # 20 m away
    mask[16:38, 24:31] = True
    moved = warp_actors(mask, warp)
    near, far = moved[:, :40], moved[:, 45:]
    assert np.count_nonzero(near) > 1.2 * 22 * 7
    assert np.count_nonzero(far) <= 1.5 * 12
    assert np.nonzero(near)[0].max() > 37


def test_piece_above_the_horizon_only_turns():
    warp = road_warp(12.0, 0.5)
    mask = np.zeros((45, 80), np.bool_)
    mask[2:6, 38:42] = True
    assert np.count_nonzero(warp_actors(mask, warp)) == pytest.approx(16, abs=4)
    assert np.nonzero(warp_actors(mask, warp))[1].min() == pytest.approx(38 + 60 * np.tan(0.05), abs=1)


def test_without_horizon_actors_move_with_the_picture():
    mask = np.random.default_rng(0).random((20, 30)) < 0.1
    assert np.array_equal(warp_actors(mask, shift(3.0)), warp_mask(mask, shift(3.0)))


def test_empty_mask_stays_empty():
    assert not warp_actors(np.zeros((45, 80), np.bool_), road_warp(10.0, 0.1)).any()
    assert not warp_mask(np.zeros((45, 80), np.bool_), road_warp(10.0, 0.1)).any()


@given(mask=hnp.arrays(np.bool_, st.tuples(st.integers(1, 20), st.integers(1, 24))))
def test_pieces_are_the_connected_ones(mask):
    """Also pieces inside the hole of another, against OpenCV's labels of the whole mask."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    found = []
    for (x, y, width, height), piece in pieces(mask):
        whole = np.zeros_like(mask)
        whole[y : y + height, x : x + width] = piece
        assert piece.any(axis=0).all() or width > 1
        found.append(whole)
    assert len(found) == count - 1
    for label in range(1, count):
        assert sum(np.array_equal(whole, labels == label) for whole in found) == 1
