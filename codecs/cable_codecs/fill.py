"""Replacing everything outside the region of interest by one colour."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np

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
    if mode not in get_args(FillMode):
        raise CodecError(f"unknown background fill {mode!r}; choose one of {', '.join(get_args(FillMode))}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise CodecError(f"the image must be uint8 [height, width, 3], got {image.dtype} {list(image.shape)}")
    if roi.dtype != np.bool_ or roi.shape != image.shape[:2]:
        raise CodecError(f"the region must be bool {list(image.shape[:2])}, got {roi.dtype} {list(roi.shape)}")
    if out is None:
        out = np.empty(image.shape, np.uint8)
    elif out.dtype != np.uint8 or out.shape != image.shape or not out.flags.c_contiguous:
        raise CodecError(f"out must be C-contiguous uint8 {list(image.shape)}, got {out.dtype} {list(out.shape)}")
    elif np.may_share_memory(image, out):
        raise CodecError("out shares memory with the image; give a separate buffer")
    keep = roi.view(np.uint8)
    out.fill(GREY if mode == "grey" else 0)
    cv2.copyTo(image, keep, out)
    if mode == "mean":
        colour = background_mean(image, out, roi)
        # Whole rows: assigning three-channel pixels is ten times slower.
        out.reshape(len(out), -1)[:] = np.tile(colour, out.shape[1])
        cv2.copyTo(image, keep, out)
    return out


def background_mean(image: Image, blacked: Image, roi: BoolMask) -> Image:
    """Mean colour uint8 [3], BGR, outside the region, from the image and its copy that is black there."""
    count = max(1, roi.size - int(np.count_nonzero(roi)))
    # Two plain sums are some ten times faster than OpenCV's mean under a mask.
    difference = np.subtract(cv2.sumElems(image)[:3], cv2.sumElems(blacked)[:3])
    return np.rint(difference / count).astype(np.uint8)
