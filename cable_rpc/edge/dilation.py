"""Adaptive dilation of the warped mask, and its fusion with residual motion (paper, section II)."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask, RoiMask

PackedRows = npt.NDArray[np.uint8]
"""uint8 [height, ceil(width / 8)]: bit i of byte j is the pixel in column ``8 j + i``."""

UNCERTAINTY_LEVELS = (85, 170, 255)
"""What is left of an uncertainty in two bits, besides 0."""

SHIFTS = np.arange(64, dtype=np.uint64)


def dilation_radius(
    config: RoiConfig,
    displacement_m: float,
    yaw_change_deg: float,
    fx: float | None = None,
    width: int | None = None,
) -> float:
    """b_k = b_0 + alpha * ||dd_k|| + beta * |dpsi_k| in pixels of the full frame.

    Args:
        config: gives b_0, alpha and beta, says whether beta is ``fx pi / 180`` where the camera is known (the
            shift of the picture's centre per degree of turn), and limits b_k to a share of the width.
        displacement_m: way driven since the mask's frame, in metres.
        yaw_change_deg: heading change since the mask's frame, in degrees, of either sign.
        fx: focal length in pixels of the full frame; None where it isn't known.
        width: of the full frame in pixels; None never limits.
    """
    per_degree_px = config.dilation_per_degree_px
    if config.dilation_from_focal_length and fx is not None:
        per_degree_px = math.radians(fx)
    radius_px = (
        config.dilation_base_px + config.dilation_per_metre_px * displacement_m + per_degree_px * abs(yaw_change_deg)
    )
    if config.max_dilation_share > 0 and width is not None:
        return min(radius_px, config.max_dilation_share * width)
    return radius_px


@lru_cache(maxsize=256)
def ellipse_rectangles(radius: int) -> tuple[tuple[int, int], ...]:
    """The nested rectangles whose union is OpenCV's elliptic kernel of size ``2 * radius + 1``.

    Returns:
        (half width, half height) of each, widths rising and heights falling.
    """
    rows = np.arange(radius + 1)
    # OpenCV's own arithmetic: its rounding decides which pixels the kernel has.
    inverse = 1.0 / (radius * radius) if radius else 0.0
    half_widths = np.rint(radius * np.sqrt((radius * radius - rows * rows) * inverse)).astype(np.int64)
    heights = {int(half_width): row for row, half_width in enumerate(half_widths)}
    return tuple(sorted(heights.items()))


class GrownRows(NamedTuple):
    """A dilated mask within the window outside of which it is empty."""

    bits: PackedRows
    top: int
    """First row of the window."""
    first_byte: int
    """First column of the window, in bytes of eight pixels."""

    def unpacked(self, width: int) -> tuple[npt.NDArray[np.uint8], tuple[slice, slice]]:
        """The window's pixels, uint8 0 or 1, and where it lies in an image of that width."""
        left = 8 * self.first_byte
        pixels = np.unpackbits(self.bits, axis=1, count=min(8 * self.bits.shape[1], width - left), bitorder="little")
        rows, columns = pixels.shape
        return pixels, (slice(self.top, self.top + rows), slice(left, left + columns))


def grow_rows(bits: PackedRows, radius: int) -> GrownRows | None:
    """Dilation of a packed mask by the elliptic kernel of size ``2 * radius + 1``; None where it is empty.

    The kernel's rows are nested: from the outermost row of the kernel to its middle one, the mask is widened to
    that row's half width and joined in, moved up and down by the row's distance. Packed, a pixel costs a bit; a
    move along columns costs nothing, and one along rows by n is a move by whole bytes of the mask moved by n mod 8.
    """
    height, row_bytes = bits.shape
    x, y, columns, rows = cv2.boundingRect(bits)
    if columns == 0:
        return None
    # Room for the widening beside each row, in the frame or not, keeps rows apart in one run of bytes.
    reach = min(radius, 8 * row_bytes)
    margin = -(-reach // 8)
    pitch = columns + 2 * margin
    size = pitch * rows
    moved, start = moved_by_bits(bits[y : y + rows, x : x + columns], margin, reach)
    wide = moved[0, start : start + size].copy()
    top, bottom = max(y - radius, 0), min(y + rows + radius, height)
    grown = np.zeros(pitch * (bottom - top), np.uint8)
    rectangles = ellipse_rectangles(radius)
    reached = 0
    for index, (half_width, half_height) in enumerate(rectangles):
        half_width = min(half_width, reach)
        for step in range(reached + 1, half_width + 1):
            for offset in (step, -step):
                byte, bit = divmod(offset, 8)
                np.bitwise_or(wide, moved[bit, start - byte : start - byte + size], out=wide)
        reached = half_width
        next_height = rectangles[index + 1][1] if index + 1 < len(rectangles) else -1
        for distance in range(min(half_height, height - 1), next_height, -1):
            for offset in {distance, -distance}:
                first, last = max(y + offset, top), min(y + rows + offset, bottom)
                if first < last:
                    target = grown[(first - top) * pitch : (last - top) * pitch]
                    source = wide[(first - y - offset) * pitch : (last - y - offset) * pitch]
                    np.bitwise_or(target, source, out=target)
    left, right = max(x - margin, 0), min(x + columns + margin, row_bytes)
    window = grown.reshape(bottom - top, pitch)[:, left - x + margin : right - x + margin]
    return GrownRows(window, top, left)


def moved_by_bits(bits: PackedRows, margin: int, reach: int) -> tuple[npt.NDArray[np.uint8], int]:
    """A packed mask, moved to the right by 0..7 pixels.

    Args:
        bits: rows to put one after the other.
        margin: empty bytes on both sides of each row.
        reach: farthest move to either side that will be asked for; remainders that none needs stay empty.

    Returns:
        uint8 [8, bytes], one run of rows per move with empty bytes before and after it, and where the run begins.
    """
    rows, columns = bits.shape
    pitch = columns + 2 * margin
    # Whole words on both sides, of more bytes than a move can ask for.
    start = 8 * (margin // 8 + 1)
    moved = np.zeros((8, start + -(-pitch * rows // 8) * 8 + start), np.uint8)
    moved[0, start : start + pitch * rows].reshape(rows, pitch)[:, margin : margin + columns] = bits
    # Little-endian words hold the pixels in their order, so a carry goes to the following word.
    words = moved.view("<u8")
    near = min(reach, 4)
    for bit in sorted({offset % 8 for offset in range(-near, near + 1)} - {0}):
        np.left_shift(words[0], SHIFTS[bit], out=words[bit])
        following = words[bit, 1:]
        np.bitwise_or(following, words[0, :-1] >> SHIFTS[64 - bit], out=following)
    return moved, start


def packed_dilation(mask: BoolMask, radius_px: float) -> GrownRows | None:
    """The mask dilated by an ellipse of radius ``ceil(radius_px)``; None where it is empty."""
    # Beyond twice the sum of the sides an ellipse covers the frame from any pixel of it.
    radius = math.ceil(min(radius_px, 2 * sum(mask.shape) + 1))
    return grow_rows(np.packbits(mask, axis=1, bitorder="little"), radius)


def dilate(mask: BoolMask, radius_px: float) -> BoolMask:
    """Mplus: dilation by an ellipse of radius ``ceil(radius_px)``, kernel size ``2 * radius + 1``.

    Equal to ``cv2.dilate`` with ``MORPH_ELLIPSE``, several times as fast.

    Args:
        mask: bool [height, width].
        radius_px: b_k, at least 0, in pixels of the mask.

    Returns:
        bool [height, width], a new array.
    """
    dilated = np.zeros(mask.shape, np.bool_)
    grown = packed_dilation(mask, radius_px)
    if grown is not None:
        pixels, window = grown.unpacked(mask.shape[1])
        dilated[window] = pixels.view(np.bool_)
    return dilated


def fuse(warped: BoolMask, dilated: BoolMask, motion: BoolMask) -> BoolMask:
    """Rraw_k = Mhat ∪ (Mplus ∩ D_k), bool [height, width] each."""
    raw = np.logical_and(dilated, motion)
    return np.logical_or(raw, warped, out=raw)


def gated_dilation(warped: BoolMask, motion: BoolMask, radius_px: float) -> BoolMask:
    """Rraw_k = Mhat ∪ (dilate(Mhat, b_k) ∩ D_k) in one go.

    Args:
        warped: bool [height, width], Mhat.
        motion: bool [height, width], D_k.
        radius_px: b_k, at least 0, in pixels of the mask.

    Returns:
        bool [height, width], a new array; equal to ``fuse`` of ``dilate``.
    """
    raw = warped.copy()
    grown = packed_dilation(warped, radius_px)
    if grown is not None:
        pixels, window = grown.unpacked(warped.shape[1])
        cv2.bitwise_and(pixels, motion.view(np.uint8)[window], dst=pixels)
        target = raw.view(np.uint8)[window]
        cv2.bitwise_or(target, pixels, dst=target)
    return raw


def grow_uncertain(mask: BoolMask, uncertainty: npt.NDArray[np.uint8], scale: int, max_radius_px: float) -> BoolMask:
    """A prior joined by what the cloud is undecided about, and by a margin that grows with the uncertainty.

    The uncertainty is rounded to two bits, levels 0, 85, 170 and 255; every pixel of a level above 0, inside the
    mask or out of it, adds an ellipse of radius ``max_radius_px * level / 255`` around itself. A cell of the
    mask's grid is as uncertain as its most uncertain pixel.

    Args:
        mask: bool [ceil(height / scale), ceil(width / scale)].
        uncertainty: uint8 [height, width], 0 = sure, 255 = wholly undecided.
        scale: pixels per cell of the mask, along each axis.
        max_radius_px: margin at 255, in pixels of the uncertainty.

    Returns:
        bool of the mask's shape, a new array.
    """
    grown = mask.copy()
    for level in UNCERTAINTY_LEVELS:
        # Pixels of higher levels get a wider ellipse later, so that they join here does no harm.
        undecided = uncertainty > level - 43
        if not undecided.any():
            break
        cells = RoiMask.from_pixels(undecided, scale).blocks
        grown |= dilate(cells, max_radius_px * level / 255 / scale)
    return grown
