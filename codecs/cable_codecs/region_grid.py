"""Regions made of square blocks: their pixels, and growing them to the grid that a codec codes in.

A region of a picture of height x width pixels in blocks of ``block_size`` is bool
[ceil(height / block_size), ceil(width / block_size)]; blocks at the right and bottom edge may hang over the
picture. A pixel mask is a region of block size 1.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError


def block_shape(height: int, width: int, block_size: int) -> tuple[int, int]:
    """(rows, columns) of a region of a picture."""
    return -(-height // block_size), -(-width // block_size)


def check_blocks(blocks: BoolMask, block_size: int, height: int, width: int) -> None:
    """Check that a region belongs to a picture.

    Raises:
        CodecError: Wrong shape, dtype or block size.
    """
    if block_size < 1:
        raise CodecError(f"block_size must be at least 1 pixel, got {block_size}")
    expected = block_shape(height, width, block_size)
    if blocks.dtype != np.bool_ or blocks.shape != expected:
        raise CodecError(
            f"a region of {width}x{height} pixels in blocks of {block_size} must be bool {list(expected)}, "
            f"got {blocks.dtype} {list(blocks.shape)}"
        )


def block_pixels(blocks: BoolMask, block_size: int) -> npt.NDArray[np.uint8]:
    """uint8 [rows * block_size, columns * block_size], 1 in the pixels of the blocks and 0 elsewhere."""
    # Up to eight columns are written at once, as one number whose bytes are all 1.
    unit = math.gcd(block_size, 8)
    ones = np.array(int.from_bytes(b"\1" * unit, "little"), f"u{unit}")
    lines = np.multiply(blocks, ones, order="C")
    if block_size > unit:
        lines = lines.repeat(block_size // unit, axis=1)
    return lines.view(np.uint8).repeat(block_size, axis=0)


def region_pixels(blocks: BoolMask, block_size: int, height: int, width: int) -> BoolMask:
    """bool [height, width], True in the pixels of a region.

    Raises:
        CodecError: The region doesn't belong to a picture of that size.
    """
    check_blocks(blocks, block_size, height, width)
    pixels = block_pixels(blocks, block_size).view(np.bool_)
    return np.ascontiguousarray(pixels[:height, :width])


def grow_to_grid(blocks: BoolMask, block_size: int, grid: int, height: int, width: int) -> BoolMask:
    """The smallest region on another grid that covers a region.

    Args:
        blocks: bool [ceil(height / block_size), ceil(width / block_size)].
        block_size: Side of a block in pixels, 1 for a pixel mask.
        grid: Side of a block of the result in pixels; neither needs to divide the other.
        height: Pixels of the picture.
        width: Pixels of the picture.

    Returns:
        bool [ceil(height / grid), ceil(width / grid)]; the argument itself where the grids are the same.

    Raises:
        CodecError: The region doesn't belong to a picture of that size, or the grid is below 1 pixel.
    """
    check_blocks(blocks, block_size, height, width)
    if grid < 1:
        raise CodecError(f"the grid must be at least 1 pixel, got {grid}")
    if grid == block_size:
        return blocks
    if grid % block_size == 0:
        return any_of_tiles(blocks, grid // block_size)
    rows, columns = block_shape(height, width, grid)
    # Which pixels of the picture a block covers ends at its edge, so blocks past it touch nothing.
    touched = any_between(blocks, *covering(rows, grid, block_size, height))
    return np.ascontiguousarray(any_between(touched.T, *covering(columns, grid, block_size, width)).T)


def any_of_tiles(blocks: BoolMask, count: int) -> BoolMask:
    """bool [ceil(rows / count), ceil(columns / count)], True where a tile of count x count cells has a True."""
    rows, columns = block_shape(blocks.shape[0], blocks.shape[1], count)
    cells = np.ascontiguousarray(blocks).view(np.uint8)
    # Tiles past the edge are completed by False; columns first, so that what is widened is small.
    strips = np.zeros((rows, columns * count), np.uint8)
    whole = blocks.shape[0] // count
    bands = cells[: whole * count].reshape(whole, count, blocks.shape[1])
    np.bitwise_or.reduce(bands, axis=1, out=strips[:whole, : blocks.shape[1]])
    if whole < rows:
        np.bitwise_or.reduce(cells[whole * count :], axis=0, out=strips[whole, : blocks.shape[1]])
    # Up to eight columns are compared at once, as one number.
    unit = math.gcd(count, 8)
    wide = strips.view(f"u{unit}").reshape(rows, columns, count // unit)
    return np.asarray(np.bitwise_or.reduce(wide, axis=2) != 0)


def covering(count: int, grid: int, block_size: int, length: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """First and last + 1 block touched by each of ``count`` cells of another grid along one axis."""
    starts = np.arange(count) * grid
    ends = np.minimum(starts + grid, length)
    return starts // block_size, -(-ends // block_size)


def any_between(blocks: BoolMask, first: npt.NDArray[np.intp], last: npt.NDArray[np.intp]) -> BoolMask:
    """bool [len(first), columns], True where a row of first..last - 1 is True; empty intervals give False."""
    before = np.zeros((len(blocks) + 1, blocks.shape[1]), np.int32)
    np.cumsum(blocks, axis=0, out=before[1:])
    return np.asarray(before[last] > before[first])
