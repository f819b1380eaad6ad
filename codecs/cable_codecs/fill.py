"""Replacing everything outside the region of interest by one colour."""

from __future__ import annotations

import math
from typing import Literal, get_args

import cv2
import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError

FillMode = Literal["zero", "grey", "mean"]
"""``zero``: black; ``grey``: level 128; ``mean``: the mean colour of this frame's background, which
changes from frame to frame and so costs a video codec bits."""

GREY = 128


def fill_background(image: Image, roi: BoolMask, mode: FillMode, *, out: Image | None = None) -> Image:
    """Copy an image, with the pixels outside the region replaced.

    Args:
        image: uint8 [height, width, 3], BGR; left unchanged.
        roi: bool [height, width], True where the image is kept.
        mode: What to put elsewhere.
        out: C-contiguous uint8 [height, width, 3] to write into, apart from ``image``; None makes a new one.

    Returns:
        uint8 [height, width, 3], BGR; ``out`` where it was given.

    Raises:
        CodecError: Unknown mode, or arrays whose shape or dtype don't fit.
    """
    target = checked_target(image, mode, out)
    if roi.dtype != np.bool_ or roi.shape != image.shape[:2]:
        raise CodecError(f"the region must be bool {list(image.shape[:2])}, got {roi.dtype} {list(roi.shape)}")
    return fill_outside(image, roi.view(np.uint8), 0, mode, target)


def fill_blocks(image: Image, blocks: BoolMask, block_size: int, mode: FillMode, *, out: Image | None = None) -> Image:
    """``fill_background`` for a region made of square blocks, without its pixels at full size.

    Args:
        image: uint8 [height, width, 3], BGR; left unchanged.
        blocks: bool [ceil(height / block_size), ceil(width / block_size)], True where the image is kept. Blocks at
            the right and bottom edge may hang over the image.
        block_size: Side of a block in pixels, at least 1.
        mode: What to put elsewhere.
        out: C-contiguous uint8 [height, width, 3] to write into, apart from ``image``; None makes a new one.

    Returns:
        uint8 [height, width, 3], BGR; ``out`` where it was given.

    Raises:
        CodecError: Unknown mode, or arrays whose shape or dtype don't fit.
    """
    target = checked_target(image, mode, out)
    if block_size < 1:
        raise CodecError(f"block_size must be at least 1 pixel, got {block_size}")
    height, width = image.shape[:2]
    expected = (-(-height // block_size), -(-width // block_size))
    if blocks.dtype != np.bool_ or blocks.shape != expected:
        raise CodecError(
            f"a region of {width}x{height} pixels in blocks of {block_size} must be bool {list(expected)}, "
            f"got {blocks.dtype} {list(blocks.shape)}"
        )
    occupied = np.flatnonzero(blocks.any(axis=1))
    # Rows above and below the region need no mask.
    first, last = (int(occupied[0]), int(occupied[-1]) + 1) if len(occupied) else (0, 0)
    keep = block_pixels(blocks[first:last], block_size)[: height - first * block_size, :width]
    return fill_outside(image, keep, first * block_size, mode, target)


def checked_target(image: Image, mode: FillMode, out: Image | None) -> Image:
    """The array to write into, once mode, image and that array are found usable."""
    if mode not in get_args(FillMode):
        raise CodecError(f"unknown background fill {mode!r}; choose one of {', '.join(get_args(FillMode))}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise CodecError(f"the image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    if out is None:
        return np.empty(image.shape, np.uint8)
    if out.dtype != np.uint8 or out.shape != image.shape or not out.flags.c_contiguous:
        raise CodecError(f"out must be C-contiguous uint8 {list(image.shape)}, got {out.dtype} {list(out.shape)}")
    if np.may_share_memory(image, out):
        raise CodecError("out shares memory with the image; give a separate buffer")
    return out


def block_pixels(blocks: BoolMask, block_size: int) -> npt.NDArray[np.uint8]:
    """uint8 [rows * block_size, columns * block_size], 1 in the pixels of the blocks and 0 elsewhere."""
    # Up to eight columns are written at once, as one number whose bytes are all 1.
    unit = math.gcd(block_size, 8)
    ones = np.array(int.from_bytes(b"\1" * unit, "little"), f"u{unit}")
    lines = np.multiply(blocks, ones, order="C")
    if block_size > unit:
        lines = lines.repeat(block_size // unit, axis=1)
    return lines.view(np.uint8).repeat(block_size, axis=0)


def fill_outside(image: Image, keep: npt.NDArray[np.uint8], top: int, mode: FillMode, out: Image) -> Image:
    """Write the image where ``keep`` is 1 in the rows from ``top`` on, and the fill everywhere else."""
    rows = slice(top, top + len(keep))
    out.fill(GREY if mode == "grey" else 0)
    copy_kept(image[rows], keep, out[rows])
    if mode == "mean":
        count = out.shape[0] * out.shape[1] - int(np.count_nonzero(keep))
        # Two plain sums are some ten times faster than OpenCV's mean under a mask.
        total = np.subtract(channel_sums(image), channel_sums(out[rows]))
        colour = np.rint(total / max(1, count)).astype(np.uint8)
        # Whole rows: assigning three-channel pixels is ten times slower.
        out.reshape(len(out), -1)[:] = np.tile(colour, out.shape[1])
        copy_kept(image[rows], keep, out[rows])
    return out


def copy_kept(image: Image, keep: npt.NDArray[np.uint8], out: Image) -> None:
    """Copy the pixels under a mask; OpenCV takes no empty arrays."""
    if keep.size:
        cv2.copyTo(image, keep, out)


def channel_sums(image: Image) -> npt.NDArray[np.float64]:
    """float64 [3], exact."""
    return np.array(cv2.sumElems(image)[:3] if image.size else (0.0, 0.0, 0.0))
