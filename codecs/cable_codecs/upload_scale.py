"""Sending a picture at a lower resolution, without losing any part of its region."""

from __future__ import annotations

import math
from typing import Literal, get_args

import cv2
import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError
from cable_codecs.region_grid import any_between, block_shape, check_blocks

Interpolation = Literal["nearest", "linear", "cubic", "lanczos"]
"""How the receiver enlarges."""

SMALLEST_SCALE = 1 / 16

FLAGS = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
REACH = {"nearest": 1, "linear": 1, "cubic": 2, "lanczos": 4}
"""Uploaded pixels beyond a region's own that enlarging it reads, on each side."""


def check_scale(scale: float, interpolation: Interpolation) -> None:
    """Check the settings of the upload resolution.

    Raises:
        CodecError: A scale outside 1/16..1, or an unknown interpolation.
    """
    if not (math.isfinite(scale) and SMALLEST_SCALE <= scale <= 1):
        raise CodecError(f"the upload scale must be {SMALLEST_SCALE}..1 of each side, got {scale}")
    if interpolation not in get_args(Interpolation):
        raise CodecError(f"unknown interpolation {interpolation!r}; choose one of {', '.join(get_args(Interpolation))}")


def uploaded_size(height: int, width: int, scale: float) -> tuple[int, int]:
    """(height, width) of the picture sent: the nearest even sides of at least 2 pixels; unchanged at scale 1."""
    if scale == 1:
        return height, width
    return max(2, 2 * round(height * scale / 2)), max(2, 2 * round(width * scale / 2))


def reduce_image(image: Image, size: tuple[int, int]) -> Image:
    """The image at a lower resolution (height, width), each pixel the mean of the area it covers."""
    return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def enlarge_image(picture: Image, size: tuple[int, int], interpolation: Interpolation) -> Image:
    """The picture at a higher resolution (height, width)."""
    return np.asarray(cv2.resize(picture, size[::-1], interpolation=FLAGS[interpolation]), np.uint8)


def uploaded_region(
    blocks: BoolMask,
    block_size: int,
    full: tuple[int, int],
    uploaded: tuple[int, int],
    grid: int,
    interpolation: Interpolation,
) -> BoolMask:
    """The smallest region of the uploaded picture that holds all that a region of the full one is made from.

    That is every uploaded pixel that a pixel of the region is averaged into, and every one that enlarging reads
    for it: what the receiver shows inside the region doesn't depend on the fill outside.

    Args:
        blocks: bool [ceil(height / block_size), ceil(width / block_size)], region of the full picture.
        block_size: Side of its blocks in pixels.
        full: (height, width) of the full picture.
        uploaded: (height, width) of the uploaded picture.
        grid: Side of the result's blocks in uploaded pixels.
        interpolation: How the receiver will enlarge.

    Returns:
        bool [ceil(uploaded height / grid), ceil(uploaded width / grid)].

    Raises:
        CodecError: The region doesn't belong to the full picture.
    """
    check_blocks(blocks, block_size, *full)
    rows, columns = block_shape(*uploaded, grid)
    reach = REACH[interpolation]
    by_rows = any_between(blocks, *reaching(rows, block_size, full[0], uploaded[0], grid, reach))
    by_columns = any_between(by_rows.T, *reaching(columns, block_size, full[1], uploaded[1], grid, reach))
    return np.ascontiguousarray(by_columns.T)


def reaching(
    count: int, block_size: int, full: int, uploaded: int, grid: int, reach: int
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """First and last + 1 block that needs each of ``count`` uploaded cells along one axis."""
    starts = np.arange(-(-full // block_size)) * block_size
    ends = np.minimum(starts + block_size, full)
    first_cell = np.maximum(starts * uploaded // full - reach, 0) // grid
    last_cell = -(-np.minimum(-(-ends * uploaded // full) + reach, uploaded) // grid)
    cells = np.arange(count)
    # Both ends of a block's cells grow with the block, so the blocks that need a cell follow each other.
    return np.searchsorted(last_cell, cells, side="right"), np.searchsorted(first_cell, cells, side="right")
