"""How actors without a prior come into the region: bands at the border, new view, lasting novelty."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cable_rpc.edge.entry import NoveltyDetector, entry_bands, first_actor_row, hull_of, new_view
from cable_rpc.edge.roi_config import RoiConfig

SIZES = st.tuples(st.integers(1, 24), st.integers(1, 40))
MASKS = SIZES.flatmap(lambda size: hnp.arrays(np.bool_, size))
GRID = (225, 400)
NOTHING = np.zeros(GRID, np.bool_)


def texture(height, width, seed, grain=16):
    """Grey patches of some pixels across, with every level between 20 and 235."""
    coarse = np.random.default_rng(seed).integers(20, 236, (height // grain + 2, width // grain + 2), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def analysed(picture):
    return cv2.resize(picture, GRID[::-1], interpolation=cv2.INTER_AREA)


def residual(now, before):
    """Residual motion of a standing vehicle as the robust mode has it: threshold and 3x3 opening."""
    moving = (cv2.absdiff(now, before) > 25).astype(np.uint8)
    return cv2.morphologyEx(moving, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.bool_)


def joined(motion, detector, config, dilated=NOTHING):
    """What entry adds to the region of one frame."""
    region = entry_bands(motion, config.entry_band_share)
    novel = detector.update(motion, dilated)
    return region if novel is None else region | novel


# --- bands --------------------------------------------------------------------------------------------


@given(motion=MASKS, share=st.integers(0, 60), first_row=st.integers(0, 24))
def test_bands_pixel_by_pixel(motion, share, first_row):
    height, width = motion.shape
    # Half up, exactly: share percent of the width; at least one column, none for share 0.
    strip = max((2 * share * width + 100) // 200, 1) if share else 0
    expected = np.zeros_like(motion)
    for y in range(height):
        for x in range(width):
            at_border = x < strip or x >= width - strip
            expected[y, x] = motion[y, x] and at_border and y >= first_row
    assert np.array_equal(entry_bands(motion, share / 100, first_row=first_row), expected)


def test_car_from_the_right_is_inside_within_two_frames():
    config = RoiConfig()
    detector = NoveltyDetector(config)
    street = texture(900, 1600, 1)
    car = texture(220, 420, 2, grain=24)
    before = analysed(street)
    for step in range(1, 9):
        visible = 30 * step
        picture, where = street.copy(), np.zeros((900, 1600), np.uint8)
        picture[480:700, 1600 - visible :] = car[:, :visible]
        where[480:700, 1600 - visible :] = 1
        now = analysed(picture)
        region = joined(residual(now, before), detector, config)
        inside = region[analysed(where * 255) > 127].mean()
        if step >= 2:
            assert inside > 0.5, f"frame {step}: {inside:.2f} of the car"
        before = now


# --- new view -----------------------------------------------------------------------------------------


def test_turn_brings_a_strip_into_view():
    valid = np.ones((20, 40), np.bool_)
    valid[:, 37:] = False
    assert np.array_equal(new_view(valid), ~valid)
    valid = np.ones((20, 40), np.bool_)
    for y in range(20):
        valid[y, : y // 5] = False
    assert np.array_equal(new_view(valid), ~valid)
    below = new_view(valid, first_row=10)
    assert not below[:10].any()
    assert np.array_equal(below[10:], ~valid[10:])


def test_holes_and_whole_rows_are_not_new():
    valid = np.ones((20, 40), np.bool_)
    valid[5, :] = False
    valid[10:12, 15:20] = False
    assert not new_view(valid).any()


def test_absurd_warp_brings_nothing():
    assert new_view(np.zeros((20, 40), np.bool_)) is None
    valid = np.zeros((20, 40), np.bool_)
    valid[:, :10] = True
    assert new_view(valid) is None
    assert new_view(valid, 0.75).sum() == 20 * 30


@pytest.mark.parametrize("valid", [None, np.ones((9, 9), np.bool_), np.zeros((0, 9), np.bool_)])
def test_nothing_new(valid):
    assert new_view(valid) is None


@given(valid=MASKS)
def test_new_view_row_by_row(valid):
    strip = new_view(valid, 1.0)
    expected = np.zeros_like(valid)
    for y, row in enumerate(valid):
        seen = np.flatnonzero(row)
        if len(seen):
            expected[y, : seen[0]] = True
            expected[y, seen[-1] + 1 :] = True
    assert np.array_equal(np.zeros_like(valid) if strip is None else strip, expected)


@pytest.mark.parametrize(("horizon", "row"), [(None, 52), (100, 77), (-30, 0), (1000, 225)])
def test_first_actor_row(horizon, row):
    assert first_actor_row(225, horizon) == row


# --- novelty ------------------------------------------------------------------------------------------


@given(points=hnp.arrays(np.int32, st.tuples(st.integers(1, 12), st.just(1), st.just(2)), elements=st.integers(0, 25)))
@settings(deadline=None)
def test_hull_area_counts_pixels(points):
    area, hull = hull_of(points)
    corners = [tuple(int(v) for v in corner[0]) for corner in hull]
    edges = list(zip(corners, corners[1:] + corners[:1], strict=True))

    def sides(x, y):
        return [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for (x0, y0), (x1, y1) in edges]

    def on_hull(x, y):
        within = min(c[0] for c in corners) <= x <= max(c[0] for c in corners)
        within &= min(c[1] for c in corners) <= y <= max(c[1] for c in corners)
        turn = sides(x, y)
        return within and (min(turn) >= 0 or max(turn) <= 0)

    assert area == sum(on_hull(x, y) for x in range(26) for y in range(26))


@pytest.mark.parametrize(("height", "counts"), [(10, False), (11, True)])
def test_least_area_is_strict(height, counts):
    """9 x 10 = 90 pixels are exactly 0.1 % of the grid."""
    detector = NoveltyDetector(RoiConfig())
    motion = NOTHING.copy()
    motion[100 : 100 + height, 200:209] = True
    assert detector.update(motion, NOTHING) is None
    assert (detector.update(motion, NOTHING) is not None) == counts


def test_region_is_the_filled_shape_and_its_surroundings():
    detector = NoveltyDetector(RoiConfig(novelty_frames=1))
    motion = NOTHING.copy()
    motion[100:141, 200:231] = True
    motion[103:138, 203:228] = False
    rows, columns = np.nonzero(detector.update(motion, NOTHING))
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    assert len(rows) == (bottom - top + 1) * (right - left + 1), "the frame's inside is filled"
    moved = np.nonzero(motion)
    # Widened by half of the 4 pixels (0.01 W) over which pieces are linked.
    assert (top, bottom) == (moved[0].min() - 2, moved[0].max() + 2)
    assert (left, right) == (moved[1].min() - 2, moved[1].max() + 2)


def test_pieces_a_little_apart_are_one_actor():
    for gap, together in ((4, True), (5, False)):
        detector = NoveltyDetector(RoiConfig(novelty_frames=1))
        motion = NOTHING.copy()
        motion[100:130, 200:202] = motion[100:130, 202 + gap : 204 + gap] = True
        # Two strips of 60 pixels each are too small, their common hull is not.
        assert (detector.update(motion, NOTHING) is not None) == together


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_must_last_for_some_frames_in_a_row(frames):
    detector = NoveltyDetector(RoiConfig(novelty_frames=frames))
    seen = []
    for k in range(12):
        motion = NOTHING.copy()
        if k != 6:
            motion[100:120, 50 + 10 * k : 70 + 10 * k] = True
        seen.append(detector.update(motion, NOTHING) is not None)
    run = [k % 7 + 1 if k < 6 else k - 6 for k in range(12)]
    assert seen == [count >= frames for count in run]


def test_far_jump_is_another_actor():
    detector = NoveltyDetector(RoiConfig())
    for k in range(6):
        motion = NOTHING.copy()
        motion[100:120, 60 * k : 60 * k + 20] = True
        assert detector.update(motion, NOTHING) is None


def test_motion_inside_the_dilated_prior_is_no_news():
    detector = NoveltyDetector(RoiConfig(novelty_frames=1))
    motion, dilated = NOTHING.copy(), NOTHING.copy()
    motion[100:130, 100:130] = True
    dilated[95:135, 95:135] = True
    assert detector.update(motion, dilated) is None


def test_motion_above_the_ground_is_no_news():
    detector = NoveltyDetector(RoiConfig(novelty_frames=1))
    motion = NOTHING.copy()
    motion[20:50, 100:130] = True
    assert detector.update(motion, NOTHING, first_row=60) is None
    assert detector.update(motion, NOTHING) is not None


def test_switched_off():
    detector = NoveltyDetector(RoiConfig(novelty_area_share=0, novelty_frames=1))
    motion = NOTHING.copy()
    motion[100:130, 100:130] = True
    assert detector.update(motion, NOTHING) is None


def test_leaves_its_arguments_alone():
    rng = np.random.default_rng(0)
    motion, dilated = rng.random(GRID) < 0.02, rng.random(GRID) < 0.02
    copies = motion.copy(), dilated.copy()
    NoveltyDetector(RoiConfig(novelty_frames=1)).update(motion, dilated, first_row=50)
    entry_bands(motion, 0.1, first_row=50)
    assert np.array_equal(motion, copies[0])
    assert np.array_equal(dilated, copies[1])


def test_noise_does_not_trigger():
    rng = np.random.default_rng(4)
    detector = NoveltyDetector(RoiConfig())
    assert all(detector.update(rng.random(GRID) < 0.005, NOTHING) is None for _ in range(50))


def test_sensor_noise_does_not_trigger():
    rng = np.random.default_rng(5)
    street = texture(900, 1600, 6).astype(np.float32)
    detector, config = NoveltyDetector(RoiConfig()), RoiConfig()
    before = None
    for _ in range(6):
        noisy = np.clip(street + rng.normal(0, 12, street.shape).astype(np.float32), 0, 255).astype(np.uint8)
        now = analysed(noisy)
        if before is not None:
            assert not joined(residual(now, before), detector, config).any()
        before = now


def test_parallax_does_not_trigger():
    wide = texture(900, 2400, 7)
    detector = NoveltyDetector(RoiConfig())
    frames = [analysed(np.ascontiguousarray(wide[:, 24 * k : 24 * k + 1600])) for k in range(10)]
    motions = [residual(now, before) for before, now in pairwise(frames)]
    assert min(motion.mean() for motion in motions) > 0.05
    assert all(detector.update(motion, NOTHING) is None for motion in motions)


def test_background_motion_ends_what_was_seen():
    detector = NoveltyDetector(RoiConfig())
    motion = NOTHING.copy()
    motion[100:120, 100:120] = True
    assert detector.update(motion, NOTHING) is None
    assert detector.update(~NOTHING, NOTHING) is None
    assert detector.update(motion, NOTHING) is None
    assert detector.update(motion, NOTHING) is not None


@pytest.mark.parametrize("frames", [2, 3])
def test_pedestrian_between_parked_cars_is_inside_in_time(frames):
    config = RoiConfig(novelty_frames=frames)
    detector = NoveltyDetector(config)
    street = texture(900, 1600, 8)
    street[450:640, 500:760] = texture(190, 260, 9, grain=30)
    person = texture(130, 44, 10, grain=12)
    parked = NOTHING.copy()
    parked[110:164, 121:194] = True
    before = analysed(street)
    came_out = None
    for step in range(1, 14):
        visible = min(14 * step, 44)
        left = 760 if visible < 44 else 760 + 14 * step - 44
        picture, where = street.copy(), np.zeros((900, 1600), np.uint8)
        picture[520:650, left : left + visible] = person[:, 44 - visible :]
        where[520:650, left : left + visible] = 255
        now, shape = analysed(picture), analysed(where) > 127
        novel = detector.update(residual(now, before), parked)
        if came_out is None and not (shape & parked).any() and visible == 44:
            came_out = step
        if came_out is not None and step >= came_out + frames - 1:
            assert novel is not None, step
            assert novel[shape].mean() > 0.6
            assert novel.mean() < 0.02
        before = now
    assert came_out is not None
