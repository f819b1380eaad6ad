"""How well a picture kept several regions of a frame: luma errors and structural similarity, computed once for all."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
from cable_codecs.quality import luma, ssim_map, without_rim

from cable_rpc.study.sweep.cell import RegionQuality
from cable_rpc.types import BoolMask, Float32Array, Image


def region_fidelity(
    reference: Image, test: Image, regions: Sequence[BoolMask], *, with_ssim: bool = True
) -> tuple[RegionQuality, ...]:
    """Squared error and SSIM of BT.601 luma in each region, as `cable_codecs.roi_psnr` and `roi_ssim` define them.

    Args:
        reference: uint8 [height, width, 3], BGR, as the camera gave it.
        test: uint8 [height, width, 3], BGR, as the models saw it.
        regions: bool [height, width] each; an empty one counts for nothing, and one that has no pixel inside its rim
            has no SSIM.
        with_ssim: False leaves SSIM out, which takes longer than all else.
    """
    first, second = luma(reference), luma(test)
    similarity = ssim_map(first.astype(np.float32), second.astype(np.float32)) if with_ssim else None
    return tuple(one_region(first, second, similarity, region) for region in regions)


def one_region(
    first: Image, second: Image, similarity: npt.NDArray[np.float32] | None, region: BoolMask
) -> RegionQuality:
    """The sums of one region of one frame."""
    inside = np.ascontiguousarray(region).view(np.uint8)
    pixels = int(cv2.countNonZero(inside))
    if not pixels:
        return RegionQuality()
    error = float(cv2.norm(first, second, cv2.NORM_L2SQR, inside))
    valid = without_rim(region)
    if similarity is None or not valid.any():
        return RegionQuality(1, pixels, error)
    return RegionQuality(1, pixels, error, float(cv2.mean(similarity, valid)[0]), 1)


def box_pixels(boxes_xyxy: Float32Array, size_hw: tuple[int, int]) -> BoolMask:
    """Every pixel that a box touches, bool [height, width].

    Args:
        boxes_xyxy: float32 [N, 4], pixels.
        size_hw: (height, width).
    """
    inside = np.zeros(size_hw, np.bool_)
    for left, top, right, bottom in boxes_xyxy:
        rows = slice(max(0, int(np.floor(top))), max(0, int(np.ceil(bottom))))
        inside[rows, max(0, int(np.floor(left))) : max(0, int(np.ceil(right)))] = True
    return inside
