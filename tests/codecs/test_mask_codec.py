"""Masks come back exactly, small, and damaged ones are refused."""

from __future__ import annotations

import zlib
from itertools import pairwise

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, decode_mask, encode_mask
from cable_codecs.mask_codec import deflate
from cable_codecs.mask_runs import bytes_to_runs, read_numbers, runs_to_bytes, write_numbers
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp


def driving_mask(height: int, width: int) -> np.ndarray:
    """A corridor and four boxes, bool [height, width]."""
    mask = np.zeros((height, width), np.uint8)
    corridor = np.array([[0.42, 0.45], [0.58, 0.45], [1.0, 1.0], [0.0, 1.0]]) * [width - 1, height - 1]
    cv2.fillPoly(mask, [corridor.astype(np.int32)], 1)
    for x, y, w, h in ((0.15, 0.4, 0.1, 0.15), (0.7, 0.35, 0.12, 0.1), (0.45, 0.4, 0.1, 0.2), (0.3, 0.6, 0.2, 0.2)):
        mask[int(y * height) : int((y + h) * height), int(x * width) : int((x + w) * width)] = 1
    return mask.astype(np.bool_)


def round_trip(mask: np.ndarray) -> bytes:
    data = encode_mask(mask)
    decoded = decode_mask(data, *mask.shape)
    assert decoded.dtype == np.bool_
    assert decoded.flags.writeable
    assert np.array_equal(decoded, mask)
    return data


@settings(max_examples=200, deadline=None)
@given(mask=hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, max_side=24)))
def test_any_mask(mask):
    round_trip(mask)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 300), columns=st.integers(1, 300), density=st.floats(0, 1))
def test_blobs_and_noise(seed, rows, columns, density):
    rng = np.random.default_rng(seed)
    field = rng.random((rows, columns)).astype(np.float32)
    if seed % 2:
        field = cv2.GaussianBlur(field, (0, 0), 1 + seed % 7)
    data = round_trip(field < np.quantile(field, density))
    assert len(data) <= rows * columns // 8 + 16


def test_masks_without_information_take_one_byte():
    assert len(round_trip(np.zeros((68, 120), bool))) == 1
    assert len(round_trip(np.ones((68, 120), bool))) == 1


def test_strided_views():
    mask = driving_mask(70, 90)
    round_trip(mask[::-1, ::2])
    round_trip(mask.T)


def test_smooth_masks_are_small():
    pixels = driving_mask(544, 960)
    blocks = pixels.reshape(68, 8, 120, 8).any(axis=(1, 3))
    assert len(round_trip(blocks)) <= 110
    assert len(round_trip(pixels)) <= 300


def test_large_ragged_and_noisy_masks():
    rng = np.random.default_rng(3)
    noise = rng.random((270, 480)).astype(np.float32)
    assert len(round_trip(noise > 0.5)) < 270 * 480 / 8 + 16
    round_trip(cv2.GaussianBlur(noise, (0, 0), 3) > 0.5)
    round_trip(np.indices((300, 301)).sum(axis=0) % 2 == 0)


def literal_runs(mask: np.ndarray) -> list[int]:
    """The byte form of the module's description, one number at a time."""
    rows = [[c for c in range(len(row)) if row[c] != (row[c - 1] if c else False)] for row in mask.tolist()]
    bands: list[list[list[int]]] = []
    for row in rows:
        if bands and len(bands[-1][-1]) == len(row):
            bands[-1].append(row)
        else:
            bands.append([row])
    numbers = [len(bands), *(len(band) for band in bands), *(len(band[0]) for band in bands)]
    start = 0
    for band in bands:
        for boundary in range(len(band[0])):
            chain = [row[boundary] for row in band]
            steps = [chain[0] - start] + [b - a for a, b in pairwise(chain)]
            numbers += [2 * step if step >= 0 else -2 * step - 1 for step in steps]
            start = chain[0]
    return numbers


@settings(max_examples=100, deadline=None)
@given(mask=hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12)))
def test_runs_follow_their_description(mask):
    data = runs_to_bytes(mask)
    assert read_numbers(data).tolist() == literal_runs(mask)
    assert np.array_equal(bytes_to_runs(data, *mask.shape), mask)


def test_numbers_are_leb128():
    values = [0, 1, 127, 128, 300, 16383, 16384, 2**21 - 1]
    expected = bytes.fromhex("00 01 7f 8001 ac02 ff7f 808001 ffff7f")
    assert write_numbers(np.array(values)) == expected
    assert read_numbers(expected).tolist() == values


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=120), rows=st.integers(1, 40), columns=st.integers(1, 40))
def test_garbage_is_refused_or_a_mask(data, rows, columns):
    try:
        mask = decode_mask(data, rows, columns)
    except CodecError:
        return
    assert mask.shape == (rows, columns)


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=60), tag=st.integers(2, 5), rows=st.integers(1, 20), columns=st.integers(1, 20))
def test_well_deflated_garbage_is_refused_or_a_mask(payload, tag, rows, columns):
    try:
        mask = decode_mask(bytes([tag]) + deflate(payload), rows, columns)
    except CodecError:
        return
    assert mask.shape == (rows, columns)


@pytest.mark.parametrize("tag", [2, 3, 4, 5])
def test_bombs_are_refused(tag):
    bomb = bytes([tag]) + deflate(bytes(10_000_000))
    with pytest.raises(CodecError, match="beyond"):
        decode_mask(bomb, 68, 120)


def test_damage_is_named():
    data = encode_mask(driving_mask(68, 120))
    with pytest.raises(CodecError, match="no data"):
        decode_mask(b"", 68, 120)
    with pytest.raises(CodecError, match="other data"):
        decode_mask(data + b"x", 68, 120)
    with pytest.raises(CodecError, match="cut"):
        decode_mask(data[:-1], 68, 120)
    with pytest.raises(CodecError, match="unknown tag 9"):
        decode_mask(b"\x09", 68, 120)
    with pytest.raises(CodecError, match="one byte"):
        decode_mask(b"\x00\x00", 68, 120)
    with pytest.raises(CodecError, match="size"):
        decode_mask(data, 67, 120)
    with pytest.raises(CodecError, match="damaged"):
        decode_mask(b"\x02" + zlib.compress(b"with a header"), 68, 120)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (20000, 1)])
def test_size_out_of_range(shape):
    with pytest.raises(CodecError, match="16384"):
        encode_mask(np.zeros(shape, bool))
    with pytest.raises(CodecError, match="16384"):
        decode_mask(b"\x00", *shape)


@pytest.mark.parametrize("mask", [np.zeros((4, 4), np.uint8), np.zeros(4, bool), np.zeros((2, 2, 2), bool)])
def test_wrong_arrays(mask):
    with pytest.raises(CodecError, match="bool"):
        encode_mask(mask)
