"""Fills against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from cable_codecs import CodecError, fill_background
from cable_codecs.fill import fill_blocks
from hypothesis import given, settings
from hypothesis import strategies as st


def literal_fill(image, roi, mode):
    filled = image.copy()
    if mode == "keep":
        return filled
    if mode == "blur":
        height, width = roi.shape
        blurred = literal_blur(image, max(1, height // 8), max(1, width // 8))
        return np.where(roi[..., None], image, np.rint(blurred))
    outside = image[~roi].astype(np.float64)
    mean = outside.mean(axis=0) if len(outside) else np.zeros(3)
    filled[~roi] = {"zero": 0, "freeze": 0, "grey": 128, "mean": np.rint(mean)}[mode]
    return filled


def literal_blur(image, rows, columns):
    """Means over equal areas, cut at fractions of a pixel, then linear interpolation between their centres."""
    height, width = image.shape[:2]
    down = [
        [area_weights(height, rows), area_weights(width, columns)],
        [linear_weights(height, rows), linear_weights(width, columns)],
    ]
    small = np.rint(np.einsum("ih,jw,hwc->ijc", *down[0], image.astype(np.float64)))
    return np.einsum("hi,wj,ijc->hwc", *down[1], small)


def area_weights(length, parts):
    weights = np.zeros((parts, length))
    for part in range(parts):
        start, end = part * length / parts, (part + 1) * length / parts
        for pixel in range(length):
            weights[part, pixel] = max(0.0, min(end, pixel + 1) - max(start, pixel)) / (end - start)
    return weights


def linear_weights(length, parts):
    weights = np.zeros((length, parts))
    for pixel in range(length):
        place = min(max((pixel + 0.5) * parts / length - 0.5, 0), parts - 1)
        low = min(int(place), parts - 1)
        high = min(low + 1, parts - 1)
        weights[pixel, low] += 1 - (place - low)
        weights[pixel, high] += place - low
    return weights


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 30),
    width=st.integers(1, 30),
    density=st.sampled_from([0.0, 0.3, 1.0]),
    mode=st.sampled_from(["zero", "grey", "mean", "freeze", "keep"]),
)
def test_fill(seed, height, width, density, mode):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    roi = rng.random((height, width)) < density
    before = image.copy()
    filled = fill_background(image, roi, mode)
    assert np.array_equal(filled, literal_fill(image, roi, mode))
    assert np.array_equal(image, before)
    out = np.zeros_like(image) if mode == "freeze" else np.full_like(image, 77)
    assert fill_background(image, roi, mode, out=out) is out
    assert np.array_equal(out, filled)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    density=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_blur(seed, height, width, density):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    roi = rng.random((height, width)) < density
    filled = fill_background(image, roi, "blur").astype(int)
    expected = literal_fill(image, roi, "blur")
    assert np.array_equal(filled[roi], expected[roi])
    # OpenCV rounds twice, to fixed-point weights and to grey levels.
    assert np.abs(filled - expected).max() <= 2
    out = np.full_like(image, 77)
    assert np.array_equal(fill_background(image, roi, "blur", out=out), filled)


def test_freeze_trails_on_its_canvas():
    rng = np.random.default_rng(0)
    canvas = np.zeros((12, 20, 3), np.uint8)
    expected = canvas.copy()
    for _ in range(5):
        image, roi = rng.integers(0, 256, (12, 20, 3), np.uint8), rng.random((12, 20)) < 0.3
        expected[roi] = image[roi]
        assert np.array_equal(fill_background(image, roi, "freeze", out=canvas), expected)


@pytest.mark.parametrize("mode", ["zero", "grey", "mean", "freeze", "keep"])
def test_views_with_strides(mode):
    rng = np.random.default_rng(0)
    image, roi = rng.integers(0, 256, (20, 30, 3), np.uint8), rng.random((20, 30)) < 0.5
    filled = fill_background(image[::2, ::-1], roi[::2, ::-1], mode)
    assert np.array_equal(filled, literal_fill(image[::2, ::-1], roi[::2, ::-1], mode))


def test_wrong_arguments_are_named():
    image, roi = np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), bool)
    with pytest.raises(CodecError, match="zero, grey, mean, blur, freeze, keep"):
        fill_background(image, roi, "pink")
    with pytest.raises(CodecError, match="image"):
        fill_background(image[..., 0], roi, "zero")
    with pytest.raises(CodecError, match="region"):
        fill_background(image, roi[:2], "zero")
    with pytest.raises(CodecError, match="region"):
        fill_background(image, roi.astype(np.uint8), "zero")
    with pytest.raises(CodecError, match="contiguous"):
        fill_background(image, roi, "zero", out=np.zeros((4, 12, 3), np.uint8)[:, ::2])
    with pytest.raises(CodecError, match="memory"):
        fill_background(image, roi, "grey", out=image)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 1000),
    size=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    block_size=st.one_of(st.sampled_from([4, 8, 16]), st.integers(1, 60)),
    density=st.sampled_from([0.0, 0.2, 0.7, 1.0]),
    mode=st.sampled_from(["zero", "grey", "mean", "freeze", "keep"]),
)
def test_blocks_are_their_pixels(seed, size, block_size, density, mode):
    rng = np.random.default_rng(seed)
    height, width = size
    image = rng.integers(0, 256, (height, width, 3), np.uint8)
    blocks = rng.random((-(-height // block_size), -(-width // block_size))) < density
    roi = np.kron(blocks, np.ones((block_size, block_size), bool))[:height, :width]
    expected = literal_fill(image, roi, mode)
    before = image.copy()
    out = np.zeros_like(image) if mode == "freeze" else np.full_like(image, 77)
    assert fill_blocks(image, blocks, block_size, mode, out=out) is out
    assert np.array_equal(out, expected)
    assert np.array_equal(image, before)
    assert np.array_equal(fill_blocks(image, blocks, block_size, mode), expected)
    assert np.array_equal(fill_blocks(image, np.asfortranarray(blocks), block_size, mode), expected)


def test_blocks_that_do_not_fit_are_named():
    image = np.zeros((20, 30, 3), np.uint8)
    with pytest.raises(CodecError, match=r"30x20.*\[3, 4\]"):
        fill_blocks(image, np.ones((3, 3), bool), 8, "zero")
    with pytest.raises(CodecError, match="bool"):
        fill_blocks(image, np.ones((3, 4), np.uint8), 8, "zero")
    with pytest.raises(CodecError, match="block_size"):
        fill_blocks(image, np.ones((3, 4), bool), 0, "zero")
    with pytest.raises(CodecError, match="zero, grey, mean, blur, freeze, keep"):
        fill_blocks(image, np.ones((3, 4), bool), 8, "pink")
    with pytest.raises(CodecError, match="memory"):
        fill_blocks(image, np.ones((3, 4), bool), 8, "zero", out=image)
