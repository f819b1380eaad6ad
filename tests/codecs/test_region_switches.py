"""Hysteresis, feathering, crop, upload scale and composing, each against a literal version."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from cable_codecs.compose import NEVER_RECEIVED, BackgroundComposer
from cable_codecs.crop import CropBox, crop, crop_box, uncrop
from cable_codecs.errors import CodecError
from cable_codecs.feather import feather_edge
from cable_codecs.hysteresis import RegionHysteresis
from cable_codecs.region_grid import block_shape, region_pixels
from cable_codecs.upload_scale import check_scale, enlarge_image, reduce_image, uploaded_region, uploaded_size
from hypothesis import given, settings
from hypothesis import strategies as st


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 1000),
    hold=st.integers(0, 4),
    most_share=st.sampled_from([0.05, 0.3, 0.6, 1.0]),
    density=st.sampled_from([0.0, 0.1, 0.4]),
)
def test_hysteresis(seed, hold, most_share, density):
    rng = np.random.default_rng(seed)
    hysteresis = RegionHysteresis(hold, most_share=most_share)
    history = []
    for _ in range(8):
        wanted = rng.random((6, 7)) < density
        history.append(wanted)
        region = hysteresis.update(wanted)
        # The longest memory whose union keeps to the share; this frame's wishes always.
        expected = wanted
        for memory in range(1, hold + 1):
            union = np.any(history[-1 - memory :], axis=0)
            if union.sum() > most_share * union.size:
                break
            expected = union
        assert np.array_equal(region, expected)
        assert not (wanted & ~region).any()
    hysteresis.reset()
    assert not hysteresis.update(np.zeros((6, 7), bool)).any()


def test_hysteresis_counts_frames():
    hysteresis = RegionHysteresis(2)
    on, off = np.ones((1, 1), bool), np.zeros((1, 1), bool)
    seen = [bool(hysteresis.update(one)[0, 0]) for one in (off, on, off, off, off, on, off, off, off)]
    assert seen == [False, True, True, True, False, True, True, True, False]


def test_hysteresis_refuses_nonsense():
    for hold, share in ((-1, 1.0), (1001, 1.0), (1, 0.0), (1, 1.1), (1, float("nan"))):
        with pytest.raises(CodecError, match="hysteresis"):
            RegionHysteresis(hold, most_share=share)
    hysteresis = RegionHysteresis(1)
    hysteresis.update(np.zeros((2, 2), bool))
    with pytest.raises(CodecError, match="reset"):
        hysteresis.update(np.zeros((2, 3), bool))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 16),
    width=st.integers(1, 16),
    density=st.sampled_from([0.0, 0.02, 0.2, 1.0]),
    feather_px=st.integers(0, 6),
)
def test_feather(seed, height, width, density, feather_px):
    rng = np.random.default_rng(seed)
    image, fill = rng.integers(0, 256, (2, height, width, 3), np.uint8)
    roi = rng.random((height, width)) < density
    filled = np.where(roi[..., None], image, fill)
    expected = filled.astype(int)
    inside = np.argwhere(roi)
    for y in range(height):
        for x in range(width):
            distance = min((max(abs(y - v), abs(x - u)) for v, u in inside), default=99)
            if 0 < distance <= feather_px:
                total = feather_px + 1
                kept = total - distance
                expected[y, x] = (
                    image[y, x].astype(int) * kept + filled[y, x].astype(int) * distance + total // 2
                ) // total
    feather_edge(image, filled, roi, feather_px)
    assert np.array_equal(filled, expected)
    assert np.array_equal(filled[roi], image[roi])


def test_feather_refuses_what_does_not_fit():
    image, roi = np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), bool)
    with pytest.raises(CodecError, match=r"0\.\.64"):
        feather_edge(image, image.copy(), roi, 65)
    with pytest.raises(CodecError, match="one size"):
        feather_edge(image, image.copy(), roi[:4], 3)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    block_size=st.sampled_from([1, 4, 8, 16]),
    density=st.sampled_from([0.0, 0.01, 0.1, 1.0]),
    mode=st.sampled_from(["none", "rows", "box"]),
    margin=st.integers(0, 9),
)
def test_crop(seed, height, width, block_size, density, mode, margin):
    rng = np.random.default_rng(seed)
    blocks = rng.random(block_shape(height, width, block_size)) < density
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    box = crop_box(blocks, block_size, height, width, mode, margin_px=margin)
    roi = region_pixels(blocks, block_size, height, width)
    near = cv2.dilate(roi.view(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    inside = np.zeros((height, width), bool)
    inside[box.slices] = True
    assert not (near.astype(bool) & ~inside).any()
    assert box.x % 16 == box.y % 16 == 0
    assert box.width % 16 == 0 or box.x + box.width == width
    assert box.height % 16 == 0 or box.y + box.height == height
    if mode != "box":
        assert (box.x, box.width) == (0, width)
    if mode == "none":
        assert box == CropBox(0, 0, width, height)
    elif roi.any():
        # Nothing smaller would do: the first and last 16 rows hold something.
        assert near[box.y : box.y + 16].any()
        assert near[max(box.y, box.y + box.height - 16) : box.y + box.height].any()
    cut = crop(image, box)
    assert cut.flags.c_contiguous
    colour = np.array([1, 2, 3], np.uint8)
    back = uncrop(cut, box, height, width, colour)
    assert np.array_equal(back, np.where(inside[..., None], image, colour))


def test_crops_that_do_not_fit_are_named():
    blocks = np.ones((2, 2), bool)
    with pytest.raises(CodecError, match="none, rows, box"):
        crop_box(blocks, 8, 16, 16, "columns")
    with pytest.raises(CodecError, match="negative"):
        CropBox(-1, 0, 4, 4)
    with pytest.raises(CodecError, match="at least one pixel"):
        CropBox(0, 0, 0, 4)
    picture = np.zeros((16, 16, 3), np.uint8)
    black = np.zeros(3, np.uint8)
    with pytest.raises(CodecError, match="beyond"):
        crop(picture, CropBox(8, 0, 16, 16))
    with pytest.raises(CodecError, match="beyond"):
        uncrop(picture, CropBox(0, 8, 16, 16), 16, 16, black)
    with pytest.raises(CodecError, match="16x8"):
        uncrop(picture, CropBox(0, 8, 16, 8), 16, 16, black)


INTERPOLATIONS = ["nearest", "linear", "cubic", "lanczos"]


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(2, 90),
    width=st.integers(2, 90),
    block_size=st.sampled_from([1, 8, 16]),
    grid=st.sampled_from([1, 8, 16]),
    scale=st.floats(1 / 16, 0.99),
    interpolation=st.sampled_from(INTERPOLATIONS),
)
def test_scaled_region_holds_all_that_its_pixels_are_made_from(
    seed, height, width, block_size, grid, scale, interpolation
):
    rng = np.random.default_rng(seed)
    full = (height, width)
    small = uploaded_size(height, width, scale)
    blocks = rng.random(block_shape(height, width, block_size)) < 0.1
    region = uploaded_region(blocks, block_size, full, small, grid, interpolation)
    roi = region_pixels(blocks, block_size, height, width)
    kept = region_pixels(region, grid, *small)
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    picture = reduce_image(image, small)
    noise = rng.integers(0, 256, picture.shape, np.uint8)
    spoiled = np.where(kept[..., None], picture, noise)
    assert np.array_equal(
        enlarge_image(spoiled, full, interpolation)[roi], enlarge_image(picture, full, interpolation)[roi]
    )
    # Pixels that the region is averaged into.
    touched = reduce_image(np.repeat(roi[..., None].astype(np.uint8) * 255, 3, axis=2), small)[..., 0] > 0
    assert not (touched & ~kept).any()


def test_scaled_region_is_not_much_larger():
    blocks = np.zeros((90, 160), bool)
    blocks[30:60, 40:80] = True
    region = uploaded_region(blocks, 8, (720, 1280), (360, 640), 8, "linear")
    expected = np.zeros((45, 80), bool)
    expected[14:31, 19:41] = True
    assert np.array_equal(region, expected)


def test_scales_that_make_no_sense_are_named():
    assert uploaded_size(375, 1241, 1.0) == (375, 1241)
    assert uploaded_size(720, 1280, 0.5) == (360, 640)
    assert uploaded_size(5, 3, 1 / 16) == (2, 2)
    for scale, interpolation in ((0.05, "linear"), (1.5, "linear"), (float("nan"), "linear"), (0.5, "sharp")):
        with pytest.raises(CodecError, match=r"scale|interpolation"):
            check_scale(scale, interpolation)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    block_size=st.sampled_from([1, 8, 16]),
    start_whole=st.booleans(),
)
def test_compose(seed, height, width, block_size, start_whole):
    rng = np.random.default_rng(seed)
    composer = BackgroundComposer(height, width, block_size)
    shown = np.zeros((height, width, 3), np.uint8)
    last = np.full(block_shape(height, width, block_size), -1)
    stamp = 100
    for number in range(6):
        image = rng.integers(0, 256, (height, width, 3), np.uint8)
        whole = number == 4 or (number == 0 and start_whole)
        blocks = None if whole else rng.random(last.shape) < 0.3
        stamp += int(rng.integers(0, 5))
        pixels = np.ones((height, width), bool) if whole else region_pixels(blocks, block_size, height, width)
        shown[pixels] = image[pixels]
        last[slice(None) if whole else blocks] = stamp
        composed = composer.compose(image, blocks, stamp=stamp)
        assert np.array_equal(composed.image, shown)
        assert np.array_equal(composed.ages, np.where(last < 0, NEVER_RECEIVED, stamp - last))
        assert composed.oldest == max(0, (stamp - last[last >= 0]).max(initial=0))
        assert composed.received_share == pytest.approx(np.mean(last >= 0))
        composed.image[:] = 255
    with pytest.raises(CodecError, match="before"):
        composer.compose(image, None, stamp=stamp - 1)
    composer.reset()
    nothing = composer.compose(image, np.zeros(last.shape, bool))
    assert not nothing.image.any()
    assert (nothing.ages == NEVER_RECEIVED).all()


def test_compose_counts_frames_by_itself():
    composer = BackgroundComposer(16, 16)
    image = np.ones((16, 16, 3), np.uint8)
    corner = np.array([[True, False], [False, False]])
    composer.compose(image, None)
    composer.compose(image, corner)
    composed = composer.compose(image * 2, ~corner)
    assert composed.ages.tolist() == [[1, 0], [0, 0]]
    assert composed.oldest == 1
    with pytest.raises(CodecError, match="uint8"):
        composer.compose(image[:8], None)
    with pytest.raises(CodecError, match="blocks of 8"):
        composer.compose(image, corner[:1])
    with pytest.raises(CodecError, match="positive"):
        BackgroundComposer(0, 16)
