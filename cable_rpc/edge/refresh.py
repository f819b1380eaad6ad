"""The refresh flag c_{k+1}: when the next frame is sent whole (paper, section II), and what it is judged by."""

from __future__ import annotations

import numpy as np

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask


def mask_iou(first: BoolMask, second: BoolMask, *, empty_masks_agree: bool = False) -> float:
    """Intersection over union of two bool [height, width].

    Args:
        first: one mask.
        second: the other.
        empty_masks_agree: two empty masks give 1; False gives 0, so they count as lost.
    """
    union = np.count_nonzero(first | second)
    if union == 0:
        return float(empty_masks_agree)
    return float(np.count_nonzero(first & second) / union)


def revealed_share(mask: BoolMask, region: BoolMask) -> float:
    """Share of a mask's pixels outside a region, both bool [height, width]; 0 for an empty mask.

    Of a keyframe's mask and the region that would have been sent in its place, this is what the keyframe has found
    that the region would have missed.
    """
    pixels = np.count_nonzero(mask)
    return float((pixels - np.count_nonzero(mask & region)) / pixels) if pixels else 0.0


def region_lost(coverage: float | None, config: RoiConfig) -> bool:
    """|R_k| / (H W) < tau_min; never where there was no R_k."""
    return coverage is not None and coverage < config.min_coverage


def prior_lost(prior_iou: float | None, config: RoiConfig) -> bool:
    """IoU(Mhat_{k-1}, M_k) < tau_iou; never where there is no agreement to judge."""
    return prior_iou is not None and prior_iou < config.min_iou


def refresh_flag(coverage: float | None, prior_iou: float | None, config: RoiConfig) -> bool:
    """c_{k+1} = 1[|R_k| / (H W) < tau_min  OR  IoU(Mhat_{k-1}, M_k) < tau_iou].

    A scene without actors has coverage 0 and is sent whole for ever: that is what the equation says.

    Args:
        coverage: share of the frame in R_k; None where there was no R_k (no mask yet).
        prior_iou: agreement of the warped prior and the mask that answered it (``mask_iou``); None where
            no answer has come or its frame had no prior, which leaves that term out.
        config: gives tau_min and tau_iou.
    """
    return region_lost(coverage, config) or prior_lost(prior_iou, config)
