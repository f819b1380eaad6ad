"""Adaptive dilation of the warped mask, and its fusion with residual motion (paper, section II)."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask


def dilation_radius(config: RoiConfig, displacement_m: float, yaw_change_deg: float) -> float:
    """b_k = b_0 + alpha * ||dd_k|| + beta * |dpsi_k| in pixels.

    Args:
        config: gives b_0, alpha and beta.
        displacement_m: way driven since the mask's frame, in metres.
        yaw_change_deg: heading change since the mask's frame, in degrees, of either sign.
    """
    return (
        config.dilation_base_px
        + config.dilation_per_metre_px * displacement_m
        + config.dilation_per_degree_px * abs(yaw_change_deg)
    )


@lru_cache(maxsize=256)
def ellipse_rectangles(radius: int) -> tuple[tuple[int, int], ...]:
    """The nested rectangles whose union is OpenCV's elliptic kernel of size ``2 * radius + 1``.

    Returns:
        (half width, half height) of each, widths rising and heights falling.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    half_widths = (np.count_nonzero(kernel[radius:], axis=1) - 1) // 2
    heights = {int(half_width): row for row, half_width in enumerate(half_widths) if half_width >= 0}
    return tuple(sorted(heights.items()))


def bounding_slices(mask: BoolMask, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns of the mask's bounding box, grown by a margin inside the image; None if empty."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    if width == 0:
        return None
    return (
        slice(max(y - margin, 0), min(y + height + margin, mask.shape[0])),
        slice(max(x - margin, 0), min(x + width + margin, mask.shape[1])),
    )


def dilate_rows(image: npt.NDArray[np.uint8], reach: int) -> npt.NDArray[np.uint8]:
    """Dilation along each row by ``reach`` pixels to both sides."""
    return cv2.dilate(image, np.ones((1, 2 * reach + 1), np.uint8)).astype(np.uint8, copy=False)


def dilate_columns(image: npt.NDArray[np.uint8], reach: int) -> npt.NDArray[np.uint8]:
    """Dilation along each column by ``reach`` pixels to both sides."""
    return cv2.dilate(image, np.ones((2 * reach + 1, 1), np.uint8)).astype(np.uint8, copy=False)


def dilate(mask: BoolMask, radius_px: float) -> BoolMask:
    """Mplus: dilation by an ellipse of radius ``ceil(radius_px)``, kernel size ``2 * radius + 1``.

    Equal to ``cv2.dilate`` with ``MORPH_ELLIPSE``, several times as fast: the ellipse is a union of nested
    rectangles, and a rectangle's dilation contains that of every smaller one, so a Horner scheme of small
    steps along rows and columns builds it within the mask's bounding box.

    Args:
        mask: bool [height, width].
        radius_px: b_k, at least 0.

    Returns:
        bool [height, width], a new array.
    """
    height, width = mask.shape
    dilated = np.zeros_like(mask)
    # Beyond twice the diagonal an ellipse covers any frame from any pixel of it.
    if radius_px > 2 * (height + width):
        dilated[:] = mask.any()
        return dilated
    radius = math.ceil(radius_px)
    window = bounding_slices(mask, radius)
    if window is None:
        return dilated
    rectangles = ellipse_rectangles(radius)
    widened = np.ascontiguousarray(mask[window]).view(np.uint8)
    grown: npt.NDArray[np.uint8] | None = None
    reached = 0
    for index, (half_width, half_height) in enumerate(rectangles):
        if half_width > reached:
            widened = dilate_rows(widened, half_width - reached)
            reached = half_width
        grown = widened if grown is None else np.bitwise_or(grown, widened)
        following = rectangles[index + 1][1] if index + 1 < len(rectangles) else 0
        if half_height > following:
            grown = dilate_columns(grown, half_height - following)
    dilated[window] = widened.view(np.bool_) if grown is None else grown.view(np.bool_)
    return dilated


def fuse(warped: BoolMask, dilated: BoolMask, motion: BoolMask) -> BoolMask:
    """Rraw_k = Mhat ∪ (Mplus ∩ D_k), bool [height, width] each."""
    raw = np.logical_and(dilated, motion)
    return np.logical_or(raw, warped, out=raw)
