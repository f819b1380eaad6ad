"""The refresh flag c_{k+1}: when the next frame is sent whole (paper, section II)."""

from __future__ import annotations

import numpy as np

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.types import BoolMask


def mask_iou(first: BoolMask, second: BoolMask) -> float:
    """Intersection over union of two bool [height, width]; two empty masks give 0, so they count as lost."""
    union = np.count_nonzero(first | second)
    return float(np.count_nonzero(first & second) / union) if union else 0.0


def refresh_flag(coverage: float | None, prior_iou: float | None, config: RoiConfig) -> bool:
    """c_{k+1} = 1[|R_k| / (H W) < tau_min  OR  IoU(Mhat_{k-1}, M_k) < tau_iou].

    A scene without actors has coverage 0 and is sent whole for ever: that is what the equation says.

    Args:
        coverage: share of the frame in R_k; None where there was no R_k (no mask yet).
        prior_iou: agreement of the warped prior and the mask that answered it (``mask_iou``); None where
            no answer has come or its frame had no prior, which leaves that term out.
        config: gives tau_min and tau_iou.
    """
    lost_region = coverage is not None and coverage < config.min_coverage
    lost_prior = prior_iou is not None and prior_iou < config.min_iou
    return lost_region or lost_prior
