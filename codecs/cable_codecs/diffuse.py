"""A background made from the region itself: its colours, spread outward until the picture is full.

Nothing has to be sent for it, and it has no edges that a detector could take for objects' outlines.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError
from cable_codecs.fill import copy_kept

DIFFUSION_STEP = 8
"""Pixels along each axis of a cell on the finest level."""

Float32Array = npt.NDArray[np.float32]


def diffuse_background(image: Image, roi: BoolMask) -> Image:
    """Replace everything outside a region by the region's colours, smoother the farther from it.

    Pull-push interpolation (Gortler et al., The Lumigraph, 1996, section 3.4) on cells of 8x8 pixels, interpolated
    linearly between their centres.

    Args:
        image: uint8 [height, width, 3], BGR; left unchanged, and not looked at outside the region.
        roi: bool [height, width], True where the image is kept.

    Returns:
        uint8 [height, width, 3], BGR; black throughout where the region is empty.

    Raises:
        CodecError: arrays whose shape or dtype don't fit.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise CodecError(f"the image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    height, width = image.shape[:2]
    if roi.dtype != np.bool_ or roi.shape != (height, width):
        raise CodecError(f"the region must be bool {[height, width]}, got {roi.dtype} {list(roi.shape)}")
    keep = roi.view(np.uint8)
    kept = np.zeros_like(image)
    copy_kept(image, keep, kept)
    if not roi.any():
        return kept
    cells_wh = (-(-width // DIFFUSION_STEP), -(-height // DIFFUSION_STEP))
    weight = cv2.resize(keep * np.float32(1), cells_wh, interpolation=cv2.INTER_AREA)
    # Averaged in floating point: a cell of which a few pixels are known would lose its colour to rounding.
    colour = cv2.resize(kept.astype(np.float32), cells_wh, interpolation=cv2.INTER_AREA)
    cells = pull_push(np.asarray(colour, np.float32), np.asarray(weight, np.float32))
    filled = cv2.resize(np.rint(cells).astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    copy_kept(image, keep, np.asarray(filled, np.uint8))
    return np.asarray(filled, np.uint8)


def pull_push(colour: Float32Array, weight: Float32Array) -> Float32Array:
    """Colours for all cells from those that have some.

    Args:
        colour: float32 [rows, columns, 3], each cell's colour times its weight.
        weight: float32 [rows, columns], 0 = nothing known, 1 = wholly known; not 0 everywhere.

    Returns:
        float32 [rows, columns, 3]: what is known where the weight is 1, and blended with the coarser levels' answer
        as it is less.
    """
    rows, columns = weight.shape
    total = np.minimum(weight, 1.0)
    own = colour * np.divide(total, weight, out=np.zeros_like(weight), where=weight > 0)[..., None]
    if rows == 1 and columns == 1:
        return np.asarray(own / total[..., None], np.float32)
    half_wh = ((columns + 1) // 2, (rows + 1) // 2)
    # Area averages times 4: a coarse cell is wholly known as soon as one of its four is.
    coarse_weight = np.asarray(cv2.resize(total, half_wh, interpolation=cv2.INTER_AREA), np.float32).reshape(
        half_wh[::-1]
    )
    coarse_colour = np.asarray(cv2.resize(own, half_wh, interpolation=cv2.INTER_AREA), np.float32)
    coarse = pull_push(coarse_colour * 4, coarse_weight * 4)
    smooth = np.asarray(cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)
    return np.asarray(own + smooth * (1.0 - total)[..., None], np.float32)
