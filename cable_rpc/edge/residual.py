"""Residual motion D_k: what the ego-motion warp does not explain (paper, section II)."""

from __future__ import annotations

import cv2
import numpy as np

from cable_rpc.edge.ego_motion import GreyImage
from cable_rpc.types import BoolMask, Image


def grey(image: Image) -> GreyImage:
    """BT.601 luma, uint8 [height, width], of a BGR image uint8 [height, width, 3]."""
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)


def residual_motion(current: GreyImage, warped: GreyImage, valid: BoolMask | None, threshold_levels: int) -> BoolMask:
    """D_k = 1[|gray(I_k) - gray(Ihat_{k-1})| > tau_e], with E_k = 0 where the warp is undefined.

    Args:
        current: uint8 [height, width], grey levels of I_k.
        warped: uint8 [height, width], grey levels of the warped previous frame.
        valid: bool [height, width], where ``warped`` is defined; None for everywhere.
        threshold_levels: tau_e in grey levels; motion is strictly above it.

    Returns:
        bool [height, width].
    """
    difference = cv2.absdiff(current, warped)
    cv2.threshold(difference, threshold_levels, 1, cv2.THRESH_BINARY, dst=difference)
    motion = difference.view(np.bool_)
    if valid is not None:
        np.logical_and(motion, valid, out=motion)
    return motion
