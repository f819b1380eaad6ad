"""The background made from the region's own colours."""

from __future__ import annotations

import numpy as np
import pytest
from cable_codecs import CodecError, RegionReceiver, RegionSender, RegionTreatment, diffuse_background
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import NearestNDInterpolator


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 90),
    width=st.integers(1, 90),
    share=st.sampled_from([0.001, 0.05, 0.5, 0.99]),
)
def test_keeps_the_region_and_stays_within_its_colours(seed, height, width, share):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    roi = rng.random((height, width)) < share
    filled = diffuse_background(image, roi)
    assert filled.shape == image.shape
    assert (filled[roi] == image[roi]).all()
    if not roi.any():
        assert not filled.any()
        return
    low, high = image[roi].min(axis=0).astype(int), image[roi].max(axis=0).astype(int)
    assert (filled >= low - 1).all()
    assert (filled <= high + 1).all()
    elsewhere = rng.integers(0, 256, image.shape, np.uint8)
    assert (diffuse_background(np.where(roi[..., None], image, elsewhere), roi) == filled).all()


def test_one_colour_fills_everything():
    image = np.zeros((100, 161, 3), np.uint8)
    roi = np.zeros((100, 161), np.bool_)
    roi[30:37, 50:90] = True
    image[roi] = (10, 120, 250)
    difference = np.abs(diffuse_background(image, roi).astype(int) - (10, 120, 250))
    assert difference.max() <= 1


def test_colours_come_from_what_is_near():
    """Far from the border between two colours a pixel has that of the nearest region pixel."""
    image = np.zeros((160, 320, 3), np.uint8)
    roi = np.zeros((160, 320), np.bool_)
    roi[72:88] = True
    image[:, :160], image[:, 160:] = (200, 40, 0), (0, 40, 200)
    rows, columns = np.nonzero(roi)
    nearest = NearestNDInterpolator(np.stack([rows, columns], axis=1), image[roi])
    filled = diffuse_background(image, roi).astype(int)
    for row, column in ((40, 20), (120, 20), (40, 300), (120, 300), (60, 80), (100, 240)):
        assert np.abs(filled[row, column] - nearest(row, column)).max() <= 25


def test_there_is_no_edge_where_the_region_ends():
    """Across the border of a smooth region the picture steps no more than inside it, give or take a cell's average."""
    ramp = np.linspace(20, 220, 256)
    image = np.repeat(np.repeat(ramp[None, :, None], 128, axis=0), 3, axis=2).astype(np.uint8)
    roi = np.zeros((128, 256), np.bool_)
    roi[48:80, 64:192] = True
    filled = diffuse_background(image, roi).astype(int)
    assert np.abs(np.diff(filled, axis=0)).max() <= 20
    black = np.where(roi[..., None], image, 0).astype(int)
    assert np.abs(np.diff(black, axis=0)).max() >= 70


@pytest.mark.parametrize("crop", ["none", "rows", "box"])
@pytest.mark.parametrize("fill", ["zero", "grey", "mean", "blur", "freeze"])
def test_the_receiver_shows_the_same_whatever_was_sent(fill, crop):
    if fill == "freeze" and crop != "none":
        pytest.skip("a frozen background can't be cropped")
    rng = np.random.default_rng(5)
    treatment = RegionTreatment(fill=fill, crop=crop, refill="diffuse")
    sender, receiver = RegionSender(treatment, 96, 128), RegionReceiver(treatment, 96, 128)
    for _ in range(3):
        image = rng.integers(0, 256, (96, 128, 3), np.uint8)
        blocks = rng.random((12, 16)) < 0.2
        sent = sender.treat(image, blocks, 8)
        shown = receiver.restore(sent.image.copy(), sent.blocks, sent.block_size)
        roi = blocks.repeat(8, axis=0).repeat(8, axis=1)
        assert (shown.image == diffuse_background(image, roi)).all()


def test_keep_and_compose_are_not_refilled():
    rng = np.random.default_rng(6)
    image = rng.integers(0, 256, (32, 32, 3), np.uint8)
    blocks = np.eye(4, dtype=np.bool_)
    for treatment in (RegionTreatment(fill="keep", refill="diffuse"), RegionTreatment(compose=True, refill="diffuse")):
        plain = RegionReceiver(RegionTreatment(fill=treatment.fill, compose=treatment.compose), 32, 32)
        shown = RegionReceiver(treatment, 32, 32).restore(image, blocks, 8).image
        assert (shown == plain.restore(image, blocks, 8).image).all()


@pytest.mark.parametrize(
    ("image", "roi", "said"),
    [
        (np.zeros((4, 4), np.uint8), np.ones((4, 4), np.bool_), "image must be"),
        (np.zeros((4, 4, 3), np.float32), np.ones((4, 4), np.bool_), "image must be"),
        (np.zeros((4, 4, 3), np.uint8), np.ones((4, 5), np.bool_), "region must be"),
        (np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.uint8), "region must be"),
    ],
)
def test_refuses_what_is_no_picture_or_region(image, roi, said):
    with pytest.raises(CodecError, match=said):
        diffuse_background(image, roi)


def test_refuses_an_unknown_refill():
    with pytest.raises(CodecError, match="unknown refill"):
        RegionTreatment(refill="inpaint")
