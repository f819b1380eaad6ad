"""Recognition: how many true objects the region holds, over the share of the object that it must hold.

The paper asks for 5 % of an object's box, at which a bumper counts as a car; the curve up to 95 % is published, and
50 % is the headline.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.types import BoolMask

Float64Array = npt.NDArray[np.float64]

RECOGNITION_THRESHOLDS = (0.05, 0.25, 0.50, 0.75, 0.95)
"""Overlaps at which recognition is published; the paper has only the first."""


def roi_overlap(truth_boxes: npt.ArrayLike, roi_pixels: BoolMask) -> Float64Array:
    """Share of each box that lies inside the region, ``|box ∩ R| / |box|``.

    A box is clipped to the image and then taken as the pixels it touches: min edges are floored, max edges
    are ceiled, in numerator and denominator alike, so the share is exact over whole pixels.

    Args:
        truth_boxes: [N, 4] xyxy in pixels, max edges exclusive.
        roi_pixels: bool [height, width].

    Returns:
        float64 [N], 0..1; 0 for a box that is empty after clipping.
    """
    height, width = roi_pixels.shape
    boxes = np.asarray(truth_boxes, np.float64).reshape(-1, 4)
    limit = np.array([width, height, width, height], np.float64)
    clipped = np.clip(boxes, 0.0, limit)
    x0, y0 = np.floor(clipped[:, :2]).astype(np.int64).T
    x1, y1 = np.ceil(clipped[:, 2:]).astype(np.int64).T
    empty = (clipped[:, 2] <= clipped[:, 0]) | (clipped[:, 3] <= clipped[:, 1])
    integral = cv2.integral(np.ascontiguousarray(roi_pixels).view(np.uint8), sdepth=cv2.CV_32S)
    inside = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
    area = (x1 - x0) * (y1 - y0)
    share: Float64Array = np.divide(inside, area, out=np.zeros(len(boxes)), where=~empty & (area > 0))
    return share


def reached_levels(
    overlaps: Float64Array, thresholds: Sequence[float] = RECOGNITION_THRESHOLDS
) -> npt.NDArray[np.bool_]:
    """Whether each object's overlap reaches each threshold, bool [len(thresholds), N]; an overlap of 0 never does."""
    levels = np.asarray(thresholds, np.float64)
    reached: npt.NDArray[np.bool_] = (overlaps[None, :] >= levels[:, None]) & (overlaps > 0.0)[None, :]
    return reached


def recognition_curve(
    truth_boxes: npt.ArrayLike,
    roi_pixels: BoolMask,
    thresholds: Sequence[float] = RECOGNITION_THRESHOLDS,
) -> npt.NDArray[np.int64]:
    """Number of recognised objects at each threshold, int64 [len(thresholds)]."""
    reached = reached_levels(roi_overlap(truth_boxes, roi_pixels), thresholds)
    return np.count_nonzero(reached, axis=1).astype(np.int64)
