"""Quantisers by object size: what is large in the picture is recognised at a coarser quantiser than what is small.

A detector resizes pictures to a fixed input, so an object's share of the picture tells how many pixels of it the
detector sees. Each connected piece of a region gets an offset that grows with the logarithm of its size.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError
from cable_codecs.region_grid import grow_to_grid
from cable_codecs.region_rectangles import Rectangle, covering_rectangles

SMALL_SIDE_SHARE = 1 / 26
"""Side of a piece, as a share of the picture's (the root of its area), up to which it gets no offset: 16 pixels of a
detector's input of 416."""
STEEPEST = 0.5


def check_size_offset(per_doubling: float, background_offset: float) -> None:
    """Check an offset by size.

    Raises:
        CodecError: Outside 0..0.5, or without a coarser background.
    """
    if not (math.isfinite(per_doubling) and 0 <= per_doubling <= STEEPEST):
        raise CodecError(f"the quantiser offset for each doubling of size must be 0..{STEEPEST}, got {per_doubling}")
    if per_doubling and not background_offset:
        raise CodecError(
            "a quantiser offset by size leaves the background finer than large objects; give quantiser_offset too"
        )


def sized_rectangles(
    roi: BoolMask, per_doubling: float, background_offset: float, most: int, grid: int
) -> list[tuple[Rectangle, float]]:
    """Pixel rectangles that cover a region, each with its offset, the finest first.

    Args:
        roi: bool [height, width], True inside.
        per_doubling: offset for each doubling of a piece's side beyond `SMALL_SIDE_SHARE`.
        background_offset: no piece gets more.
        most: rectangles at most; with more pieces than that the region is covered without offsets.
        grid: side of a block that has one quantiser, in pixels.
    """
    height, width = roi.shape
    blocks = grow_to_grid(roi, 1, grid, height, width)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(blocks.view(np.uint8), connectivity=8)
    pieces = sorted(range(1, count), key=lambda piece: int(statistics[piece, cv2.CC_STAT_AREA]))
    if len(pieces) > most:
        return [(one.scaled(grid, height, width), 0.0) for one in covering_rectangles(blocks, most)]
    found: list[tuple[Rectangle, float]] = []
    small = SMALL_SIDE_SHARE * math.sqrt(height * width)
    for place, piece in enumerate(pieces):
        side = grid * math.sqrt(int(statistics[piece, cv2.CC_STAT_AREA]))
        offset = min(background_offset, per_doubling * max(0.0, math.log2(side / small)))
        share = max(1, (most - len(found)) // (len(pieces) - place))
        cover = covering_rectangles(np.asarray(labels == piece, np.bool_), share)
        found += [(one.scaled(grid, height, width), offset) for one in cover]
    return found
