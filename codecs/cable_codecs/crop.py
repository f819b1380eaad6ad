"""Sending only the part of a picture around its region, and putting it back in place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError
from cable_codecs.fill import paint
from cable_codecs.region_grid import check_blocks

CropMode = Literal["none", "rows", "box"]
"""``rows``: whole rows from the region's first to its last; ``box``: columns too."""

CROP_ALIGNMENT = 16
"""A multiple of this many pixels lies left of and above a crop: the coding units of 4:2:0 JPEG and of H.264, so that
the coded blocks inside are those of the whole picture."""


@dataclass(frozen=True, slots=True)
class CropBox:
    """What was sent of a picture, in its pixels."""

    x: int
    y: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.x, self.y) < 0 or min(self.width, self.height) < 1:
            raise CodecError(
                f"crop {self.width}x{self.height} at ({self.x}, {self.y}) must have at least one pixel, none at a "
                "negative place"
            )

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    def check_inside(self, height: int, width: int) -> None:
        """Check that the crop is a part of a picture.

        Raises:
            CodecError: It reaches beyond it.
        """
        if self.x + self.width > width or self.y + self.height > height:
            raise CodecError(
                f"crop {self.width}x{self.height} at ({self.x}, {self.y}) reaches beyond its picture of "
                f"{width}x{height}"
            )


def check_crop_mode(mode: CropMode) -> None:
    """Check the name of a crop mode.

    Raises:
        CodecError: Unknown.
    """
    if mode not in get_args(CropMode):
        raise CodecError(f"unknown crop {mode!r}; choose one of {', '.join(get_args(CropMode))}")


def crop_box(
    blocks: BoolMask, block_size: int, height: int, width: int, mode: CropMode, *, margin_px: int = 0
) -> CropBox:
    """The smallest aligned box around a region; both ends compute the same.

    Args:
        blocks: bool [ceil(height / block_size), ceil(width / block_size)], the region.
        block_size: Side of a block in pixels.
        height: Pixels of the picture.
        width: Pixels of the picture.
        mode: ``none`` gives the whole picture.
        margin_px: Pixels around the region that must be inside too.

    Returns:
        Its sides lie on multiples of 16 pixels or on the picture's edge. An empty region keeps the first 16 rows,
        or 16x16 pixels, since no codec takes an empty picture.

    Raises:
        CodecError: Unknown mode, or the region doesn't belong to the picture.
    """
    check_crop_mode(mode)
    check_blocks(blocks, block_size, height, width)
    if mode == "none":
        return CropBox(0, 0, width, height)
    y, bottom = aligned_extent(np.asarray(blocks.any(axis=1)), block_size, height, margin_px)
    x, right = (
        aligned_extent(np.asarray(blocks.any(axis=0)), block_size, width, margin_px) if mode == "box" else (0, width)
    )
    return CropBox(x, y, right - x, bottom - y)


def aligned_extent(occupied: BoolMask, block_size: int, length: int, margin_px: int) -> tuple[int, int]:
    """First and last + 1 pixel of the occupied blocks along one axis, moved out to the alignment."""
    found = np.flatnonzero(occupied)
    if not len(found):
        return 0, min(CROP_ALIGNMENT, length)
    first = max(0, int(found[0]) * block_size - margin_px)
    last = (int(found[-1]) + 1) * block_size + margin_px
    return first - first % CROP_ALIGNMENT, min(length, last + -last % CROP_ALIGNMENT)


def crop(image: Image, box: CropBox) -> Image:
    """The part of an image, contiguous; the argument's memory where the box holds whole rows.

    Raises:
        CodecError: The box reaches beyond the image.
    """
    box.check_inside(*image.shape[:2])
    return np.ascontiguousarray(image[box.slices])


def uncrop(picture: Image, box: CropBox, height: int, width: int, colour: npt.NDArray[np.uint8]) -> Image:
    """The full picture again, one colour around what was sent.

    Args:
        picture: uint8 [box.height, box.width, 3].
        box: Where it stood.
        height: Pixels of the full picture.
        width: Pixels of the full picture.
        colour: uint8 [3], BGR.

    Returns:
        uint8 [height, width, 3]; the argument itself where the box is the full picture.

    Raises:
        CodecError: The picture isn't of the box's size, or the box reaches beyond the full picture.
    """
    box.check_inside(height, width)
    if picture.shape != (box.height, box.width, 3):
        raise CodecError(f"the picture is {list(picture.shape)}, its crop says {box.width}x{box.height}")
    if (box.height, box.width) == (height, width):
        return picture
    full = np.empty((height, width, 3), np.uint8)
    paint(full, colour)
    full[box.slices] = picture
    return full
