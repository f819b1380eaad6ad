"""Numbers that say how well a frame was perceived and how much of it was sent; pure functions over arrays.

Detections and truth are compared in the merged groups of ``cable_rpc.types.CLASS_GROUPS`` (a van called
truck or car is one vehicle). Objects of classes outside those groups take no part on either side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.edge import refresh
from cable_rpc.types import CLASS_GROUPS, BoolMask, Detections, Float32Array, GroundTruth, Int32Array

Float64Array = npt.NDArray[np.float64]

RECOGNITION_THRESHOLDS = (0.05, 0.25, 0.50, 0.75, 0.95)
"""Overlaps at which recognition is published; the paper has only the first."""


@dataclass(frozen=True, slots=True)
class MatchCounts:
    """Outcome of matching detections with truth; add counts of frames to pool them."""

    true_positives: int
    false_positives: int
    false_negatives: int

    def __add__(self, other: MatchCounts) -> MatchCounts:
        return MatchCounts(
            self.true_positives + other.true_positives,
            self.false_positives + other.false_positives,
            self.false_negatives + other.false_negatives,
        )


@dataclass(frozen=True, slots=True)
class Scores:
    """Precision, recall and F1, each 0..1; None where undefined."""

    precision: float | None
    recall: float | None
    f1: float | None


@dataclass(frozen=True, slots=True)
class RetentionCounts:
    """ROI-only detections held against the detections on the full frame."""

    retained: int
    """Full-frame detections found again in the ROI-only frame."""
    reference_count: int
    """All full-frame detections."""
    spurious: int
    """ROI-only detections without a full-frame counterpart."""


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Median and tails of a sample, in the sample's unit."""

    p50: float
    p95: float
    p99: float


def box_iou(boxes_a: npt.ArrayLike, boxes_b: npt.ArrayLike) -> Float64Array:
    """Intersection over union of every pair of boxes.

    Args:
        boxes_a: [N, 4] xyxy in pixels, max edges exclusive.
        boxes_b: [M, 4] likewise.

    Returns:
        float64 [N, M]; 0 where both boxes are empty.
    """
    a = np.asarray(boxes_a, np.float64).reshape(-1, 4)
    b = np.asarray(boxes_b, np.float64).reshape(-1, 4)
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    intersection = np.clip(high - low, 0.0, None).prod(axis=2)
    area_a = np.clip(a[:, 2:] - a[:, :2], 0.0, None).prod(axis=1)
    area_b = np.clip(b[:, 2:] - b[:, :2], 0.0, None).prod(axis=1)
    union = area_a[:, None] + area_b[None, :] - intersection
    ratio: Float64Array = np.divide(intersection, union, out=np.zeros_like(union), where=union > 0.0)
    return ratio


def match_detections(
    detections: Detections,
    truth_boxes: Float32Array,
    truth_class_ids: Int32Array,
    iou_threshold: float = 0.5,
    *,
    counted: npt.NDArray[np.bool_] | None = None,
) -> MatchCounts:
    """Match one frame's detections with its truth, one-to-one, greedily by falling score.

    Each detection takes the free truth object of its class group with the largest IoU, if that reaches the
    threshold.

    Args:
        detections: Of one frame.
        truth_boxes: float32 [N, 4] xyxy in pixels.
        truth_class_ids: int32 [N], contiguous COCO-80 indices.
        iou_threshold: Least IoU of a match.
        counted: bool [N], False for objects too small or hidden to be asked for: they are nobody's miss, and
            a detection that finds one is neither right nor wrong. All count by default.

    Returns:
        The counts of this frame.
    """
    truth_groups = [CLASS_GROUPS.get(int(class_id)) for class_id in truth_class_ids]
    asked = np.ones(len(truth_groups), np.bool_) if counted is None else np.asarray(counted, np.bool_)
    asked = asked & np.array([group is not None for group in truth_groups], np.bool_)
    overlaps = box_iou(detections.boxes_xyxy, truth_boxes)
    free = np.ones(len(truth_groups), np.bool_)
    true_positives = false_positives = 0
    for row in np.argsort(-detections.scores, kind="stable"):
        group = CLASS_GROUPS.get(int(detections.class_ids[row]))
        if group is None:
            continue
        same_group = np.array([other == group for other in truth_groups], np.bool_)
        candidates = free & same_group & (overlaps[row] >= iou_threshold)
        # An object that counts is preferred to one that doesn't, whatever their IoU (the COCO rule).
        pool = candidates & asked if (candidates & asked).any() else candidates
        if not pool.any():
            false_positives += 1
            continue
        best = int(np.argmax(np.where(pool, overlaps[row], -1.0)))
        free[best] = False
        true_positives += int(asked[best])
    return MatchCounts(true_positives, false_positives, int(asked.sum()) - true_positives)


def scores_of(counts: MatchCounts) -> Scores:
    """Precision, recall and F1 of one set of counts: pooled over a run (``micro``) or of one frame.

    Nothing to find and nothing found scores 1 throughout. Nothing to find but something found: precision and
    F1 are 0, recall is undefined. Something to find and nothing found: all 0.
    """
    found = counts.true_positives + counts.false_positives
    wanted = counts.true_positives + counts.false_negatives
    if wanted == 0:
        return Scores(1.0, 1.0, 1.0) if found == 0 else Scores(0.0, None, 0.0)
    precision = counts.true_positives / found if found else 0.0
    return Scores(precision, counts.true_positives / wanted, 2.0 * counts.true_positives / (found + wanted))


def macro_frame(frames: Iterable[MatchCounts]) -> Scores:
    """Mean of the per-frame scores, undefined values skipped; this is how the paper averages."""
    per_frame = [scores_of(counts) for counts in frames]
    return Scores(
        mean_or_none(frame.precision for frame in per_frame),
        mean_or_none(frame.recall for frame in per_frame),
        mean_or_none(frame.f1 for frame in per_frame),
    )


def roi_overlap(truth_boxes: npt.ArrayLike, roi_pixels: BoolMask) -> Float64Array:
    """Share of each box that lies inside the region, ``|box ∩ R| / |box|``.

    A box is clipped to the image and then taken as the pixels it touches: min edges are floored, max edges
    are ceiled, in numerator and denominator alike, so the share is exact over whole pixels.

    Args:
        truth_boxes: [N, 4] xyxy in pixels, max edges exclusive.
        roi_pixels: bool [height, width].

    Returns:
        float64 [N], 0..1; 0 for a box that is empty after clipping.
    """
    height, width = roi_pixels.shape
    boxes = np.asarray(truth_boxes, np.float64).reshape(-1, 4)
    limit = np.array([width, height, width, height], np.float64)
    clipped = np.clip(boxes, 0.0, limit)
    x0, y0 = np.floor(clipped[:, :2]).astype(np.int64).T
    x1, y1 = np.ceil(clipped[:, 2:]).astype(np.int64).T
    empty = (clipped[:, 2] <= clipped[:, 0]) | (clipped[:, 3] <= clipped[:, 1])
    integral = cv2.integral(np.ascontiguousarray(roi_pixels).view(np.uint8), sdepth=cv2.CV_32S)
    inside = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
    area = (x1 - x0) * (y1 - y0)
    share: Float64Array = np.divide(inside, area, out=np.zeros(len(boxes)), where=~empty & (area > 0))
    return share


def recognition_curve(
    truth_boxes: npt.ArrayLike,
    roi_pixels: BoolMask,
    thresholds: Sequence[float] = RECOGNITION_THRESHOLDS,
) -> npt.NDArray[np.int64]:
    """Number of recognised objects at each threshold, int64 [len(thresholds)]."""
    overlap = roi_overlap(truth_boxes, roi_pixels)
    levels = np.asarray(thresholds, np.float64)
    reached = (overlap[None, :] >= levels[:, None]) & (overlap > 0.0)[None, :]
    return np.count_nonzero(reached, axis=1).astype(np.int64)


def retained(full_frame: Detections, roi_only: Detections, iou_threshold: float = 0.5) -> RetentionCounts:
    """Which full-frame detections the ROI-only frame still gives, and what it adds that was not there."""
    counts = match_detections(roi_only, full_frame.boxes_xyxy, full_frame.class_ids, iou_threshold)
    return RetentionCounts(
        retained=counts.true_positives,
        reference_count=counts.true_positives + counts.false_negatives,
        spurious=counts.false_positives,
    )


def visible_truth(
    truth: GroundTruth, *, min_height_px: float = 25.0, min_visibility: float = 0.5
) -> npt.NDArray[np.bool_]:
    """Objects large and open enough to be asked for (the ``visible`` variant of the truth), bool [N]."""
    heights = truth.boxes_xyxy[:, 3] - truth.boxes_xyxy[:, 1]
    return (heights >= min_height_px) & (truth.visibility >= min_visibility)


def mask_iou(mask_a: BoolMask, mask_b: BoolMask) -> float:
    """Intersection over union of two bool [height, width] masks; 1 where both are empty."""
    return refresh.mask_iou(mask_a, mask_b, empty_masks_agree=True)


def pixel_saving(coverage: float) -> float:
    """Share of pixels not sent; says nothing about bytes."""
    return 1.0 - coverage


def percentiles(values: Iterable[float | None]) -> Percentiles | None:
    """p50, p95 and p99 with linear interpolation, None values left out; None for an empty sample."""
    sample = [value for value in values if value is not None]
    if not sample:
        return None
    p50, p95, p99 = np.percentile(np.asarray(sample, np.float64), (50.0, 95.0, 99.0))
    return Percentiles(float(p50), float(p95), float(p99))


def mean_or_none(values: Iterable[float | None]) -> float | None:
    """Mean of the values that are finite numbers; None where there is none."""
    sample = [float(value) for value in values if value is not None and np.isfinite(value)]
    return sum(sample) / len(sample) if sample else None
