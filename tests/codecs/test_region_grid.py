"""Growing regions to a grid and covering them by rectangles, against pixel-by-pixel versions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from cable_codecs.errors import CodecError
from cable_codecs.region_grid import block_shape, grow_to_grid, region_pixels
from cable_codecs.region_rectangles import Rectangle, covering_rectangles
from hypothesis import given, settings
from hypothesis import strategies as st


def literal_pixels(blocks, block_size, height, width):
    return np.array([[blocks[y // block_size, x // block_size] for x in range(width)] for y in range(height)], bool)


def literal_grid(pixels, grid):
    height, width = pixels.shape
    rows, columns = -(-height // grid), -(-width // grid)
    tiles = [
        [pixels[r * grid : (r + 1) * grid, c * grid : (c + 1) * grid] for c in range(columns)] for r in range(rows)
    ]
    return np.array([[tile.any() for tile in row] for row in tiles], bool)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 60),
    width=st.integers(1, 60),
    block_size=st.integers(1, 20),
    grid=st.one_of(st.sampled_from([8, 16]), st.integers(1, 24)),
    density=st.sampled_from([0.0, 0.05, 0.4, 1.0]),
)
def test_growing(seed, height, width, block_size, grid, density):
    blocks = np.random.default_rng(seed).random(block_shape(height, width, block_size)) < density
    before = blocks.copy()
    pixels = literal_pixels(blocks, block_size, height, width)
    assert np.array_equal(region_pixels(blocks, block_size, height, width), pixels)
    grown = grow_to_grid(blocks, block_size, grid, height, width)
    assert grown.dtype == np.bool_
    assert np.array_equal(grown, literal_grid(pixels, grid))
    assert np.array_equal(grow_to_grid(np.asfortranarray(blocks), block_size, grid, height, width), grown)
    assert np.array_equal(blocks, before)
    assert not (pixels & ~region_pixels(grown, grid, height, width)).any()
    assert np.array_equal(grow_to_grid(grown, grid, grid, height, width), grown)


def test_regions_that_do_not_fit_are_named():
    with pytest.raises(CodecError, match=r"30x20.*\[3, 4\]"):
        grow_to_grid(np.ones((3, 3), bool), 8, 16, 20, 30)
    with pytest.raises(CodecError, match="grid"):
        grow_to_grid(np.ones((3, 4), bool), 8, 0, 20, 30)
    with pytest.raises(CodecError, match="bool"):
        region_pixels(np.ones((3, 4), np.uint8), 8, 20, 30)


def painted(rectangles, shape):
    cells = np.zeros(shape, bool)
    for one in rectangles:
        assert 0 <= one.top < one.bottom <= shape[0]
        assert 0 <= one.left < one.right <= shape[1]
        cells[one.top : one.bottom, one.left : one.right] = True
    return cells


def literal_joining(rectangles, most):
    joined = list(rectangles)
    while len(joined) > most:
        unions = [first.union(second) for first, second in pairwise(joined)]
        added = [
            union.area - first.area - second.area
            for union, first, second in zip(unions, joined[:-1], joined[1:], strict=True)
        ]
        place = int(np.argmin(added))
        joined[place : place + 2] = [unions[place]]
    return tuple(joined)


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 1000),
    rows=st.integers(1, 20),
    columns=st.integers(1, 20),
    density=st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]),
    most=st.integers(1, 30),
)
def test_rectangles_cover(seed, rows, columns, density, most):
    blocks = np.random.default_rng(seed).random((rows, columns)) < density
    exact = covering_rectangles(blocks, rows * columns)
    assert np.array_equal(painted(exact, blocks.shape), blocks)
    assert sum(one.area for one in exact) == blocks.sum()
    few = covering_rectangles(blocks, most)
    assert len(few) <= most
    assert not (blocks & ~painted(few, blocks.shape)).any()
    assert few == literal_joining(exact, most)


def test_simple_shapes_take_few_rectangles():
    blocks = np.zeros((10, 12), bool)
    assert covering_rectangles(blocks, 5) == ()
    blocks[2:8, 3:9] = True
    assert covering_rectangles(blocks, 5) == (Rectangle(2, 8, 3, 9),)
    blocks[4:6] = True
    assert len(covering_rectangles(blocks, 5)) == 3
    with pytest.raises(CodecError, match="at least 1"):
        covering_rectangles(blocks, 0)
    with pytest.raises(CodecError, match="bool"):
        covering_rectangles(blocks.astype(int), 3)
    assert Rectangle(1, 3, 0, 2).scaled(16, 40, 30) == Rectangle(16, 40, 0, 30)
