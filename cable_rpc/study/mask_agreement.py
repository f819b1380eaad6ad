"""How well two masks agree: region similarity J and boundary accuracy F of the DAVIS benchmark.

Source: Perazzi et al., "A Benchmark Dataset and Evaluation Methodology for Video Object Segmentation", CVPR 2016.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from cable_rpc.study.metrics import mask_iou
from cable_rpc.types import BoolMask

BOUNDARY_SHARE = 0.008
"""Distance within which boundaries match, as a share of the image diagonal."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """Both measures, 0..1; 1 where both masks are empty."""

    region: float
    """J, intersection over union."""
    boundary: float
    """F, harmonic mean of the boundary's precision and recall."""

    @property
    def mean(self) -> float:
        """J&F."""
        return (self.region + self.boundary) / 2


def agreement(found: BoolMask, reference: BoolMask) -> Agreement:
    """J and F of two masks, bool [height, width] each."""
    return Agreement(mask_iou(found, reference), boundary_accuracy(found, reference))


def boundary_accuracy(found: BoolMask, reference: BoolMask) -> float:
    """F: a boundary pixel counts as right where the other boundary is within 0.8 % of the diagonal.

    Args:
        found: bool [height, width].
        reference: bool [height, width].
    """
    radius = math.ceil(BOUNDARY_SHARE * math.hypot(*found.shape))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    edges = boundary(found), boundary(reference)
    if not edges[0].any() and not edges[1].any():
        return 1.0
    if not edges[0].any() or not edges[1].any():
        return 0.0
    reach = [cv2.dilate(edge.view(np.uint8), disc).view(np.bool_) for edge in edges]
    precision = np.count_nonzero(edges[0] & reach[1]) / np.count_nonzero(edges[0])
    recall = np.count_nonzero(edges[1] & reach[0]) / np.count_nonzero(edges[1])
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def boundary(mask: BoolMask) -> BoolMask:
    """Pixels that differ from their right, lower or diagonal lower right neighbour, as DAVIS draws boundaries."""
    edge = np.zeros_like(mask)
    edge[:, :-1] |= mask[:, :-1] ^ mask[:, 1:]
    edge[:-1] |= mask[:-1] ^ mask[1:]
    edge[:-1, :-1] |= mask[:-1, :-1] ^ mask[1:, 1:]
    return edge
