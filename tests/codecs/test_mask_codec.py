"""Masks come back exactly, small, and damaged ones are refused."""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from itertools import pairwise

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, decode_mask, encode_mask
from cable_codecs.mask_codec import deflate
from cable_codecs.mask_context import MOST_DECISIONS, encode_by_context
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
    assert len(round_trip(blocks)) <= 75
    assert len(round_trip(pixels)) <= 160


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


class LiteralContextDecoder:
    """Form 6 as the wire protocol describes it, word by word, with fractions of Python's big integers."""

    def __init__(self, data: bytes) -> None:
        self.data, self.position = data, 0
        self.low, self.high = 0, 2**32 - 1
        self.counts = {context: [6, 2] if 18 <= context <= 49 else [2, 2] for context in range(98)}

    def ask(self, context: int) -> bool:
        no, yes = self.counts[context]
        middle = self.low + (self.high - self.low) * yes // (no + yes)
        window = self.data[self.position : self.position + 4]
        answer = int.from_bytes(window + bytes(4 - len(window)), "big") <= middle
        self.low, self.high = (self.low, middle) if answer else (middle + 1, self.high)
        self.counts[context][answer] += 5
        if sum(self.counts[context]) > 1024:
            self.counts[context] = [(count + 1) // 2 for count in self.counts[context]]
        while self.low // 2**24 == self.high // 2**24:
            self.low = self.low * 256 % 2**32
            self.high = self.high * 256 % 2**32 + 255
            self.position += 1
        return answer

    def mask(self, rows: int, columns: int) -> np.ndarray:
        cells = np.zeros((rows, columns), bool)

        def cell(row: int, column: int) -> bool:
            return bool(cells[row, min(max(column, 0), columns - 1)]) if row >= 0 else False

        same = [False]
        for _ in range(rows):
            same.append(self.ask(int(same[-1])))
        for row in range(rows):
            if same[row + 1]:
                cells[row] = cells[row - 1] if row else False
                continue
            column = 0
            while column < columns:
                north = cell(row - 1, column)
                west = cell(row, column - 1) if column else north
                north_west, north_east = cell(row - 1, column - 1), cell(row - 1, column + 1)
                far = cell(row - 2, column)
                if not west == north_west == north == north_east:
                    context = 2 + (north_west != west) + 2 * (north != west) + 4 * (north_east != west)
                    cells[row, column] = west ^ self.ask(context + 8 * (far != west))
                    column += 1
                    continue
                end = column
                while end < columns and cell(row - 1, end + 1) == north:
                    end += 1
                length, by_row = end - column, end == columns
                if not self.ask(18 + 16 * by_row + length.bit_length()):
                    cells[row, column:end] = west
                    column = end
                    continue
                bits = 1
                while bits < length.bit_length() and self.ask(50 + 16 * by_row + bits):
                    bits += 1
                number = 1
                for place in reversed(range(bits - 1)):
                    number = 2 * number + self.ask(82 + place)
                different = column + number - 1 if by_row else column + length - number
                cells[row, column:different] = west
                cells[row, different] = not west
                column = different + 1
        return cells


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 40), columns=st.integers(1, 60), grain=st.floats(0.3, 6))
def test_context_form_follows_the_wire_protocol(seed, rows, columns, grain):
    rng = np.random.default_rng(seed)
    field = cv2.GaussianBlur(rng.random((rows, columns)).astype(np.float32), (0, 0), grain)
    mask = field > np.quantile(field, rng.random())
    data = encode_by_context(mask)
    assert data is not None
    assert np.array_equal(LiteralContextDecoder(data[:-1]).mask(rows, columns), mask)
    assert data[-1] == zlib.crc32(np.packbits(mask).tobytes()) % 256


FIXED = np.zeros((9, 14), bool)
FIXED[2:7, 3:8] = FIXED[4:, 10:12] = FIXED[5, 9] = FIXED[8, 0] = True


@pytest.mark.parametrize(
    "data",
    [
        "0263606060fcc07e40dea0f6e067069e060300",
        "0363606060fcc0c0c060c0c8c0c27ea0810100",
        "0463656262666464606261626163e062e06400120c2c8c4c2c0c0ccc2ce24c422c00",
        "05636764626564646262646062001202dc0c40c005229899981900",
        "063cc2638307888191a0cf",
    ],
)
def test_format_stays_as_it_is(data):
    assert np.array_equal(decode_mask(bytes.fromhex(data), 9, 14), FIXED)


def test_budget():
    ragged = cv2.GaussianBlur(np.random.default_rng(1).random((300, 400)).astype(np.float32), (0, 0), 4) > 0.5
    forms = {limit: encode_mask(ragged, limit) for limit in (0, 8192, MOST_DECISIONS)}
    assert forms[0][0] != 6
    assert forms[MOST_DECISIONS][0] == 6
    assert len(forms[MOST_DECISIONS]) < len(forms[0])
    for data in forms.values():
        assert np.array_equal(decode_mask(data, *ragged.shape), ragged)
    for limit in (-1, MOST_DECISIONS + 1):
        with pytest.raises(CodecError, match="budget"):
            encode_mask(ragged, limit)


def test_endless_decisions_are_refused():
    noise = np.random.default_rng(1).random((200, 300)) > 0.5
    data = encode_by_context(noise, 10**6)
    with pytest.raises(CodecError, match="32768 decisions"):
        decode_mask(b"\x06" + data, 200, 300)


@settings(max_examples=200, deadline=None)
@given(change=st.integers(1, 255), place=st.integers(0, 10_000), cut=st.integers(1, 5))
def test_damaged_context_form_is_nearly_always_noticed(change, place, cut):
    data = encode_mask(driving_mask(68, 120))
    assert data[0] == 6
    damaged = bytearray(data)
    damaged[1 + place % (len(data) - 1)] ^= change
    for bad in (bytes(damaged), data[:-cut], data + b"x"):
        try:
            mask = decode_mask(bad, 68, 120)
        except CodecError:
            continue
        assert mask.shape == (68, 120)


def test_few_damages_go_unnoticed():
    data = encode_mask(driving_mask(68, 120))
    unnoticed = 0
    for place in range(1, len(data)):
        for bit in range(8):
            damaged = bytearray(data)
            damaged[place] ^= 1 << bit
            try:
                decode_mask(bytes(damaged), 68, 120)
                unnoticed += 1
            except CodecError:
                pass
    assert unnoticed <= 2


MEMORY_PROBE = """
import json, resource, sys
import numpy as np
from cable_codecs import CodecError, decode_mask
from cable_codecs.mask_codec import deflate
from cable_codecs.mask_runs import write_numbers
rows, columns = 1280, 3840
def packed(head, shifts=0):
    return deflate(write_numbers(np.array(head)) + bytes([2]) * shifts)
forms = {
    "zeros in bits": b"\2" + deflate(bytes(20_000_000)),
    "zeros in runs": b"\4" + deflate(bytes(20_000_000)),
    "all changes": b"\4" + packed([1, rows, columns], rows * columns),
    "huge counts": b"\5" + packed([1, columns, 2**21 - 1]),
    "many bands": b"\4" + packed([rows, *[1] * rows, *[480] * rows], rows * 480),
    "endless context": b"\6" + bytes(1_000_000),
}
decode_mask(b"\1", rows, columns)
limit = 200 << 20
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + limit, used + limit))
results = {}
for name, data in forms.items():
    try:
        results[name] = str(decode_mask(data, rows, columns).shape)
    except CodecError as error:
        results[name] = "refused: " + str(error)
print(json.dumps(results))
"""


def test_bombs_stay_within_memory():
    done = subprocess.run([sys.executable, "-c", MEMORY_PROBE], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads(done.stdout)
    assert all(result.startswith("refused") for name, result in results.items() if name != "many bands"), results
    assert "beyond" in results["all changes"]


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=120), rows=st.integers(1, 40), columns=st.integers(1, 40))
def test_garbage_is_refused_or_a_mask(data, rows, columns):
    try:
        mask = decode_mask(data, rows, columns)
    except CodecError:
        return
    assert mask.shape == (rows, columns)


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=60), tag=st.integers(2, 6), rows=st.integers(1, 20), columns=st.integers(1, 20))
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
    data = encode_mask(driving_mask(68, 120), 0)
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
