"""The view's motion between two frames from the pictures alone: no calibration, no ego-motion needed."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge.view_warp import GreyImage, Homography, ViewWarp
from cable_rpc.types import BoolMask, RoiMask

Points = npt.NDArray[np.float32]

WORKING_WIDTH = 400
"""Columns of the picture in which features are followed: their reach is some 20 pixels of it."""
CELL_PX = 20
"""At most one feature is taken from each square of this size, so that no busy corner outvotes the rest."""
MIN_CORNER_EIGENVALUE = 2e-4
"""Weaker corners (least eigenvalue of the gradient matrix) can't be followed."""
ACTOR_MARGIN_PX = 4
"""Features this near to an actor see its outline move."""
BORDER_PX = 3
WINDOW_PX = 11
PYRAMID_LEVELS = 2
"""Halvings above the picture: with the window, motion of about 20 px is within reach."""
TRACKING_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 8, 0.03)
INLIER_PX = 2.0
"""A street is no plane; parallax of this much is tolerated."""
ESTIMATOR_ROUNDS = 200
MIN_INLIERS = 12
MIN_INLIER_SHARE = 0.3
MAX_SCALE_CHANGE = 1.5
"""Of lengths, at any of the picture's corners, from one frame to the next."""


def estimate_view_motion(previous: GreyImage, current: GreyImage, moving: BoolMask | None) -> ViewWarp | None:
    """One homography for the whole picture, from sparse features followed from frame to frame.

    Strongest corner of each cell (Shi and Tomasi 1994), pyramidal Lucas-Kanade (Bouguet 2001), robust fit with a
    fixed random state: the same pictures give the same answer.

    Args:
        previous: uint8 [height, width]; features are followed in a picture of about 400 columns.
        current: uint8 [height, width].
        moving: bool [height, width], pixels of ``previous`` that may move by themselves; None for nowhere.

    Returns:
        The forward map from ``previous`` to ``current``; None where too few features agree on a plausible one.
    """
    shrink = round(previous.shape[1] / WORKING_WIDTH)
    if shrink > 1:
        pictures = shrunk(previous, shrink), shrunk(current, shrink)
        small = estimate_view_motion(*pictures, shrunk_mask(moving, shrink))
        return None if small is None else small.scaled(shrink)
    features = grid_corners(previous, moving)
    if len(features) < MIN_INLIERS:
        return None
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        features,
        np.empty_like(features),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=PYRAMID_LEVELS,
        criteria=TRACKING_STEPS,
    )
    followed = status.ravel() == 1
    return fitted_motion(features[followed], found[followed], previous.shape)


def shrunk(picture: GreyImage, factor: int) -> GreyImage:
    """Means over squares of ``factor`` pixels; what hangs over at the right and bottom is left out."""
    size = (picture.shape[1] // factor, picture.shape[0] // factor)
    whole = picture[: size[1] * factor, : size[0] * factor]
    return cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def shrunk_mask(mask: BoolMask | None, factor: int) -> BoolMask | None:
    """Squares that a mask touches, of those that `shrunk` keeps."""
    if mask is None:
        return None
    blocks = RoiMask.from_pixels(mask, factor).blocks
    return blocks[: mask.shape[0] // factor, : mask.shape[1] // factor]


def grid_corners(grey: GreyImage, moving: BoolMask | None) -> Points:
    """The strongest corner of each cell of a grid.

    Args:
        grey: uint8 [height, width].
        moving: bool [height, width], where not to look; None looks everywhere.

    Returns:
        float32 [N, 2], x and y in pixels.
    """
    height, width = grey.shape
    rows, columns = height // CELL_PX, width // CELL_PX
    if rows == 0 or columns == 0:
        return np.empty((0, 2), np.float32)
    strength = cv2.cornerMinEigenVal(grey, 3)
    strength[:BORDER_PX] = strength[-BORDER_PX:] = 0
    strength[:, :BORDER_PX] = strength[:, -BORDER_PX:] = 0
    if moving is not None:
        size = 2 * ACTOR_MARGIN_PX + 1
        strength[cv2.dilate(moving.view(np.uint8), np.ones((size, size), np.uint8)).view(np.bool_)] = 0
    squares = strength[: rows * CELL_PX, : columns * CELL_PX].reshape(rows, CELL_PX, columns, CELL_PX)
    cells = squares.transpose(0, 2, 1, 3).reshape(rows * columns, CELL_PX * CELL_PX)
    best = cells.argmax(axis=1)
    strong = np.flatnonzero(cells[np.arange(len(best)), best] > MIN_CORNER_EIGENVALUE)
    best = best[strong]
    x = strong % columns * CELL_PX + best % CELL_PX
    y = strong // columns * CELL_PX + best // CELL_PX
    return np.column_stack([x, y]).astype(np.float32)


def fitted_motion(before: Points, after: Points, size_hw: tuple[int, ...]) -> ViewWarp | None:
    """The homography most pairs agree on; None where too few do or it can't be a camera's motion.

    Args:
        before: float32 [N, 2], pixels.
        after: float32 [N, 2], where they went.
        size_hw: the picture's size.
    """
    if len(before) < MIN_INLIERS:
        return None
    fitted, inliers = cv2.findHomography(before, after, cv2.USAC_FAST, INLIER_PX, maxIters=ESTIMATOR_ROUNDS)
    if fitted is None or not np.isfinite(fitted).all():
        return None
    homography = np.asarray(fitted, np.float64)
    count = int(np.count_nonzero(inliers))
    if count < max(MIN_INLIERS, math.ceil(MIN_INLIER_SHARE * len(before))):
        return None
    return ViewWarp(homography) if is_plausible(homography, size_hw) else None


def is_plausible(homography: Homography, size_hw: tuple[int, ...]) -> bool:
    """Whether no corner of the picture comes to lie behind the camera, is mirrored or scaled beyond reason."""
    height, width = size_hw
    corners = np.array([[0, width - 1, 0, width - 1], [0, 0, height - 1, height - 1], [1.0, 1, 1, 1]])
    depth = homography[2] @ corners
    if not (depth > 0).all():
        return False
    # Area grows by det / depth^3 at each point.
    growth = np.linalg.det(homography) / depth**3
    limit = MAX_SCALE_CHANGE**2
    return bool((growth > 1 / limit).all() and (growth < limit).all())
