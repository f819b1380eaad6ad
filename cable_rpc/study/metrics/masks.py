"""Agreement of two masks, of one frame and pooled over frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cable_rpc.edge import refresh
from cable_rpc.types import BoolMask


@dataclass(frozen=True, slots=True)
class MaskOverlap:
    """Pixels that two masks share and that they cover together; add those of frames to pool them."""

    intersection_px: int
    union_px: int

    def __add__(self, other: MaskOverlap) -> MaskOverlap:
        return MaskOverlap(self.intersection_px + other.intersection_px, self.union_px + other.union_px)

    @property
    def iou(self) -> float:
        """Intersection over union, 0..1; 1 where both masks are empty."""
        return self.intersection_px / self.union_px if self.union_px else 1.0


def mask_overlap(mask_a: BoolMask, mask_b: BoolMask) -> MaskOverlap:
    """Counts of two bool [height, width] masks."""
    return MaskOverlap(int(np.count_nonzero(mask_a & mask_b)), int(np.count_nonzero(mask_a | mask_b)))


def mask_iou(mask_a: BoolMask, mask_b: BoolMask) -> float:
    """Intersection over union of two bool [height, width] masks; 1 where both are empty."""
    return refresh.mask_iou(mask_a, mask_b, empty_masks_agree=True)
