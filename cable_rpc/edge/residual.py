"""Residual motion D_k: what the ego-motion warp does not explain (paper, section II)."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.view_warp import GreyImage
from cable_rpc.types import BoolMask, Image

CLEANING_SIDE_PX = 3
"""Side of the blur and of the opening, in pixels of the full frame."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution in median absolute deviations."""


def grey(image: Image) -> GreyImage:
    """BT.601 luma, uint8 [height, width], of a BGR image uint8 [height, width, 3]."""
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)


def analysis_grey(image: Image, scale: int) -> GreyImage:
    """Grey levels on the analysis grid: the mean of each cell of ``scale`` x ``scale`` pixels.

    The mean is taken of the rounded luma ``grey`` gives. Where a cell hangs over the right or bottom border, the
    last column or row is repeated. A factor 2 in the scale is a halving of its own, rounded to the nearest level,
    halves up, and so is what is left of the scale after them (halves to even): the result is within half a level
    per rounding of the exact mean.

    Args:
        image: uint8 [height, width, 3], BGR.
        scale: pixels per cell, along each axis; 1 is ``grey``.

    Returns:
        uint8 [ceil(height / scale), ceil(width / scale)].
    """
    cells = grey(image)
    if scale == 1:
        return cells
    height, width = cells.shape
    below, beside = -height % scale, -width % scale
    if below or beside:
        cells = uint8(cv2.copyMakeBorder(cells, 0, below, 0, beside, cv2.BORDER_REPLICATE))
    # Halvings have a path of their own in OpenCV, five times as fast as one averaging over larger cells.
    while scale % 2 == 0:
        cells = averaged(cells, 2)
        scale //= 2
    return cells if scale == 1 else averaged(cells, scale)


def averaged(cells: GreyImage, factor: int) -> GreyImage:
    """Rounded means of squares of ``factor`` x ``factor``, which both sides are multiples of."""
    size = (cells.shape[1] // factor, cells.shape[0] // factor)
    return uint8(cv2.resize(cells, size, interpolation=cv2.INTER_AREA))


def uint8(array: cv2.typing.MatLike) -> npt.NDArray[np.uint8]:
    """An OpenCV result that is uint8 already, with its type."""
    return array.astype(np.uint8, copy=False)


def residual_motion(current: GreyImage, warped: GreyImage, valid: BoolMask | None, threshold_levels: float) -> BoolMask:
    """D_k = 1[|gray(I_k) - gray(Ihat_{k-1})| > tau_e], with E_k = 0 where the warp is undefined.

    Args:
        current: uint8 [height, width], grey levels of I_k.
        warped: uint8 [height, width], grey levels of the warped previous frame.
        valid: bool [height, width], where ``warped`` is defined; None for everywhere.
        threshold_levels: tau_e in grey levels; motion is strictly above it.

    Returns:
        bool [height, width].
    """
    return above(uint8(cv2.absdiff(current, warped)), valid, threshold_levels)


def above(difference: GreyImage, valid: BoolMask | None, threshold_levels: float) -> BoolMask:
    """Where a difference is valid and strictly above a threshold; the result takes the difference's memory."""
    cv2.threshold(difference, math.floor(threshold_levels), 1, cv2.THRESH_BINARY, dst=difference)
    if valid is not None:
        cv2.bitwise_and(difference, valid.view(np.uint8), dst=difference)
    return difference.view(np.bool_)


def motion_map(
    current: GreyImage, warped: GreyImage, valid: BoolMask | None, config: RoiConfig, scale: int
) -> BoolMask:
    """D_k as the settings want it: blur, difference, threshold, opening, and removal of small pieces.

    With the noise factor, blur, opening and least area off, it is ``residual_motion``. Lengths in pixels of the
    full frame are divided by ``scale``, whole cells counting: above a scale of 1, whose cells are means already,
    blur and opening do nothing, and neither does a least area of one cell or less.

    Args:
        current: uint8 [rows, columns], grey levels of I_k on the analysis grid.
        warped: uint8 [rows, columns], those of the warped previous frame.
        valid: bool [rows, columns], where ``warped`` is defined; None for everywhere.
        config: the ``residual_*`` settings and ``min_residual_area_px``.
        scale: pixels of the full frame per analysis pixel, along each axis.

    Returns:
        bool [rows, columns].
    """
    side = CLEANING_SIDE_PX // scale
    if config.residual_blur and side > 1:
        current, warped = uint8(cv2.blur(current, (side, side))), uint8(cv2.blur(warped, (side, side)))
        if valid is not None:
            # Near the warp's border the mean takes in pixels that are undefined.
            valid = cv2.erode(valid.view(np.uint8), np.ones((side, side), np.uint8)).view(np.bool_)
    difference = uint8(cv2.absdiff(current, warped))
    threshold: float = config.residual_threshold_levels
    if config.residual_noise_factor > 0:
        threshold = noise_threshold(difference, valid, config.residual_noise_factor)
    motion = above(difference, valid, threshold)
    if config.residual_opening and side > 1:
        motion = opened(motion, side)
    least_area = config.min_residual_area_px / (scale * scale)
    return motion if least_area <= 1 else without_small_pieces(motion, least_area)


def noise_threshold(difference: GreyImage, valid: BoolMask | None, factor: float, floor: float = 10.0) -> float:
    """max(floor, factor * 1.4826 * MAD(E)), a threshold that follows the noise of the frame itself.

    ``MAD(E) = median(|E - median(E)|)`` over the valid pixels of E = |gray(I_k) - gray(Ihat_{k-1})|. Both are the
    ordinary median, the mean of the two middle values where their number is even. E is the magnitude of the
    difference, whose own median is above 0: on normal noise of standard deviation s, ``1.4826 * MAD(E)`` is
    0.59 s, and a factor of 6 asks for 3.55 s.

    Args:
        difference: uint8 [height, width], E.
        valid: bool [height, width], where E is defined; None for everywhere.
        factor: robust standard deviations above which a difference is motion.
        floor: least threshold in grey levels, the result where no pixel is valid.

    Returns:
        The threshold in grey levels, at least ``floor``.
    """
    mask = None if valid is None else valid.view(np.uint8)
    counts = cv2.calcHist([difference], [0], mask, [256], [0.0, 256.0]).ravel().astype(np.int64)
    if not counts.any():
        return floor
    levels = np.arange(256, dtype=np.float64)
    deviations = np.abs(levels - weighted_median(levels, counts))
    rising = np.argsort(deviations)
    return max(floor, factor * MAD_TO_SIGMA * weighted_median(deviations[rising], counts[rising]))


def weighted_median(rising: npt.NDArray[np.float64], counts: npt.NDArray[np.int64]) -> float:
    """Median of rising values that occur so many times each, at least one of them at all."""
    below = np.cumsum(counts)
    total = int(below[-1])
    lower, upper = np.searchsorted(below, ((total - 1) // 2, total // 2), side="right")
    return float(rising[lower] + rising[upper]) / 2


def opened(motion: BoolMask, side: int) -> BoolMask:
    """Opening by a square of an odd side: what such a square doesn't fit into is removed."""
    square = np.ones((side, side), np.uint8)
    return uint8(cv2.morphologyEx(motion.view(np.uint8), cv2.MORPH_OPEN, square)).view(np.bool_)


def without_small_pieces(motion: BoolMask, least_area: float) -> BoolMask:
    """The map without its 8-connected pieces of fewer than ``least_area`` pixels."""
    # OpenCV's own areas cost ten times the labels on a whole frame; motion is a small part of it.
    labels = cv2.connectedComponents(motion.view(np.uint8), connectivity=8)[1].ravel()
    moving = np.flatnonzero(motion)
    piece = labels[moving]
    kept = np.zeros(motion.size, np.bool_)
    kept[moving] = (np.bincount(piece) >= least_area)[piece]
    return kept.reshape(motion.shape)
