"""Detection retention: what of the whole frame's detections the received frame still gives, and what it invents.

The paper reports the first alone, which can reach 100 % while precision falls.
"""

from __future__ import annotations

from dataclasses import dataclass

from cable_rpc.study.metrics.matching import match_detections
from cable_rpc.types import Detections


@dataclass(frozen=True, slots=True)
class RetentionCounts:
    """ROI-only detections held against the detections on the full frame; add counts of frames to pool them."""

    retained: int
    """Full-frame detections found again in the ROI-only frame."""
    reference_count: int
    """All full-frame detections."""
    spurious: int
    """ROI-only detections without a full-frame counterpart."""

    def __add__(self, other: RetentionCounts) -> RetentionCounts:
        return RetentionCounts(
            self.retained + other.retained,
            self.reference_count + other.reference_count,
            self.spurious + other.spurious,
        )

    @property
    def rate(self) -> float | None:
        """Share of the full-frame detections that were retained; None without any."""
        return self.retained / self.reference_count if self.reference_count else None

    @property
    def spurious_rate(self) -> float | None:
        """Share of the ROI-only detections without a full-frame counterpart; None without any."""
        found = self.retained + self.spurious
        return self.spurious / found if found else None


def retained(full_frame: Detections, roi_only: Detections, iou_threshold: float = 0.5) -> RetentionCounts:
    """Which full-frame detections the ROI-only frame still gives, and what it adds that was not there."""
    counts = match_detections(roi_only, full_frame.boxes_xyxy, full_frame.class_ids, iou_threshold)
    return RetentionCounts(
        retained=counts.true_positives,
        reference_count=counts.true_positives + counts.false_negatives,
        spurious=counts.false_positives,
    )
