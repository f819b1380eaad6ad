"""Which of CLIP's patches see the region of interest R_k, and so become tokens of the language model."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.errors import ModelError
from cable_models.lisa.images import ClipGeometry

BoolMask = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]

ROUNDING_PX = 1e-6
"""Areas (square frame pixels) closer than this are the same: far above the rounding of the sums, far below a pixel."""


def kept_patches(
    roi: BoolMask, geometry: ClipGeometry, patch_size: int, *, min_overlap: float = 0.01, ring: int = 0
) -> BoolMask:
    """The patches whose footprint in the frame overlaps R_k enough.

    A patch is kept if R_k covers any of it and at least ``min_overlap`` of its area inside the frame. Padding
    ("pad" fit) belongs to neither. Where R_k is the whole frame every patch is kept, those of pure padding too:
    then nothing may differ from a model that selects nothing. Where R_k lies wholly outside what CLIP sees
    (the sides of a wide frame under "crop") no patch is kept, and the caller decides what to do.

    Args:
        roi: bool [H, W], True inside R_k.
        geometry: Mapping of that frame onto CLIP's input.
        patch_size: Side of a patch in CLIP pixels.
        min_overlap: Least share of a patch's area in the frame, 0..1.
        ring: Adds the neighbours, diagonal ones too, up to this many patches away.

    Returns:
        bool [rows, columns], row 0 at the top, in the order of CLIP's tokens.

    Raises:
        ModelError: the mask isn't bool [H, W] of the geometry's frame, or a parameter is out of range.
    """
    check_selection(roi, geometry, min_overlap, ring)
    integral = np.asarray(cv2.integral(roi.view(np.uint8)), np.int32)
    y_edges, x_edges = geometry.patch_edges(patch_size)
    if integral[-1, -1] == roi.size:
        return np.ones((len(y_edges) - 1, len(x_edges) - 1), np.bool_)
    y_edges, x_edges = y_edges.clip(0, roi.shape[0]), x_edges.clip(0, roi.shape[1])
    covered = np.diff(np.diff(integral_at(integral, y_edges, x_edges), axis=0), axis=1)
    area = np.diff(y_edges)[:, None] * np.diff(x_edges)
    kept = (covered > ROUNDING_PX) & (covered >= min_overlap * area - ROUNDING_PX)
    return with_ring(kept, ring)


def check_selection(roi: BoolMask, geometry: ClipGeometry, min_overlap: float, ring: int) -> None:
    """Refuses a mask of another frame and parameters out of range.

    Raises:
        ModelError: what is wrong.
    """
    if not isinstance(roi, np.ndarray) or roi.dtype != np.bool_ or roi.shape != geometry.frame:
        found = f"{roi.dtype} {roi.shape}" if isinstance(roi, np.ndarray) else type(roi).__name__
        raise ModelError(f"the ROI must be bool {geometry.frame} as its CLIP geometry says, got {found}")
    if not 0 <= min_overlap <= 1:
        raise ModelError(f"min_overlap is a share of a patch, 0..1, got {min_overlap}")
    if ring < 0:
        raise ModelError(f"ring is a number of patches, 0 or more, got {ring}")


def integral_at(integral: npt.NDArray[np.int32], rows: FloatArray, columns: FloatArray) -> FloatArray:
    """An integral image on a grid of positions between its pixels.

    The integral of an image that is constant within each pixel is bilinear within each pixel, so this is exact.

    Args:
        integral: int32 [H + 1, W + 1], sums over everything above and left.
        rows: float64 [R], 0..H.
        columns: float64 [C], 0..W.

    Returns:
        float64 [R, C].
    """
    top, left = np.floor(rows).astype(np.intp), np.floor(columns).astype(np.intp)
    bottom, right = np.minimum(top + 1, integral.shape[0] - 1), np.minimum(left + 1, integral.shape[1] - 1)
    down, across = (rows - top)[:, None], columns - left
    upper = integral[np.ix_(top, left)] * (1 - across) + integral[np.ix_(top, right)] * across
    lower = integral[np.ix_(bottom, left)] * (1 - across) + integral[np.ix_(bottom, right)] * across
    return upper * (1 - down) + lower * down


def with_ring(kept: BoolMask, ring: int) -> BoolMask:
    """The kept patches and their neighbours up to ``ring`` patches away, diagonal ones too."""
    if ring == 0:
        return kept
    neighbourhood = np.ones((2 * ring + 1, 2 * ring + 1), np.uint8)
    return cv2.dilate(kept.view(np.uint8), neighbourhood).view(np.bool_)
