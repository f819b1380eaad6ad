"""A gradual edge: the background fades into its fill over some pixels."""

from __future__ import annotations

import cv2
import numpy as np

from cable_codecs.base import BoolMask, Image
from cable_codecs.errors import CodecError

MAX_FEATHER = 64


def check_feather(feather_px: int) -> None:
    """Check the width of a feathered edge.

    Raises:
        CodecError: Outside 0..64 pixels.
    """
    if not 0 <= feather_px <= MAX_FEATHER:
        raise CodecError(f"the feathered edge must be 0..{MAX_FEATHER} pixels wide, got {feather_px}")


def feather_edge(image: Image, filled: Image, roi: BoolMask, feather_px: int) -> None:
    """Blend the image into the filled picture along the outside of the region.

    A pixel at chessboard distance d = 1..w from the region gets (w + 1 - d) / (w + 1) of the image and the rest of
    the fill, rounded half up. Pixels inside and farther out stay.

    Args:
        image: uint8 [height, width, 3], the whole picture.
        filled: C-contiguous uint8 [height, width, 3], the picture with its background filled; changed in place.
        roi: bool [height, width], True inside.
        feather_px: w.

    Raises:
        CodecError: Width out of range, or arrays that don't fit together.
    """
    check_feather(feather_px)
    if image.shape != filled.shape or roi.shape != image.shape[:2] or not filled.flags.c_contiguous:
        raise CodecError(
            f"image {list(image.shape)}, filled picture {list(filled.shape)} and region {list(roi.shape)} must be of "
            "one size, and the filled picture contiguous"
        )
    if feather_px == 0 or not roi.any():
        return
    rows = np.flatnonzero(roi.any(axis=1))
    band = slice(max(0, int(rows[0]) - feather_px), int(rows[-1]) + feather_px + 1)
    outside = np.ascontiguousarray(~roi[band]).view(np.uint8)
    distance = cv2.distanceTransform(outside, cv2.DIST_C, 3)
    ring = np.flatnonzero((distance > 0) & (distance <= feather_px))
    steps = feather_px + 1
    weight = (steps - distance.reshape(-1)[ring]).astype(np.uint32)[:, None]
    fresh = image[band].reshape(-1, 3)[ring]
    old = filled[band].reshape(-1, 3)
    blended = (fresh * weight + old[ring] * (steps - weight) + steps // 2) // steps
    old[ring] = blended.astype(np.uint8)
