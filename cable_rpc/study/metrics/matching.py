"""Matching of detections with truth, one-to-one and greedy by falling score, as COCO's evaluation matches.

Detections and truth are compared in the merged groups of ``cable_rpc.types.CLASS_GROUPS`` (a van called
truck or car is one vehicle). Objects of classes outside those groups take no part on either side.
Source: Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014, and its evaluation code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics.truth_selection import GROUPS, group_indices
from cable_rpc.types import CLASS_GROUPS, Detections, Float32Array, Int32Array

Float64Array = npt.NDArray[np.float64]

IGNORED_REGION_SHARE = 0.5
"""Share of its area in one ignored region from which a detection is not held against anybody."""


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
class FrameMatches:
    """One frame's detections of counted classes in falling score, matched at several IoU thresholds.

    As every detection chooses before those of lower score, the outcome of the best k is that of matching them alone.
    """

    scores: Float32Array
    """float32 [D], falling."""
    groups: npt.NDArray[np.int64]
    """int64 [D], place in ``GROUPS``."""
    correct: npt.NDArray[np.bool_]
    """bool [T, D], the detection found an object that is asked for."""
    excused: npt.NDArray[np.bool_]
    """bool [T, D], neither right nor wrong: it found an object that isn't asked for, or lies in an ignored region."""
    asked: npt.NDArray[np.int64]
    """int64 [G], objects asked for."""

    def at(self, rows: slice) -> FrameMatches:
        """The same at some of the thresholds."""
        return replace(self, correct=self.correct[rows], excused=self.excused[rows])

    def counts(self, min_score: float = 0.0) -> npt.NDArray[np.int64]:
        """True positives, false positives and false negatives of the detections from a score on, int64 [T, G, 3]."""
        kept = self.scores >= min_score
        member = (self.groups[:, None] == np.arange(len(GROUPS))) & kept[:, None]
        right = self.correct.astype(np.int64) @ member
        wrong = (~self.correct & ~self.excused).astype(np.int64) @ member
        return np.stack([right, wrong, self.asked - right], axis=2)


def box_iou(boxes_a: npt.ArrayLike, boxes_b: npt.ArrayLike) -> Float64Array:
    """Intersection over union of every pair of boxes.

    Args:
        boxes_a: [N, 4] xyxy in pixels, max edges exclusive.
        boxes_b: [M, 4] likewise.

    Returns:
        float64 [N, M]; 0 where both boxes are empty.
    """
    intersection, area_a, area_b = box_intersections(boxes_a, boxes_b)
    union = area_a[:, None] + area_b[None, :] - intersection
    ratio: Float64Array = np.divide(intersection, union, out=np.zeros_like(union), where=union > 0.0)
    return ratio


def inside_share(boxes: npt.ArrayLike, regions: npt.ArrayLike) -> Float64Array:
    """Largest share of each box's area that lies in any single region.

    Args:
        boxes: [N, 4] xyxy in pixels, max edges exclusive.
        regions: [M, 4] likewise.

    Returns:
        float64 [N], 0..1; 0 for an empty box and where there is no region.
    """
    intersection, area, _ = box_intersections(boxes, regions)
    share = np.divide(intersection, area[:, None], out=np.zeros_like(intersection), where=area[:, None] > 0.0)
    return share.max(axis=1, initial=0.0)


def box_intersections(
    boxes_a: npt.ArrayLike, boxes_b: npt.ArrayLike
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Areas in px^2: of every pair's intersection, float64 [N, M], of the first boxes [N] and of the second [M]."""
    a = np.asarray(boxes_a, np.float64).reshape(-1, 4)
    b = np.asarray(boxes_b, np.float64).reshape(-1, 4)
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    intersection = np.clip(high - low, 0.0, None).prod(axis=2)
    area_a = np.clip(a[:, 2:] - a[:, :2], 0.0, None).prod(axis=1)
    area_b = np.clip(b[:, 2:] - b[:, :2], 0.0, None).prod(axis=1)
    return intersection, area_a, area_b


def match_frame(
    detections: Detections,
    truth_boxes: npt.ArrayLike,
    truth_class_ids: Int32Array,
    iou_thresholds: Sequence[float],
    *,
    counted: npt.NDArray[np.bool_] | None = None,
    ignored_boxes: npt.ArrayLike | None = None,
    region_shares: Sequence[float] | None = None,
) -> FrameMatches:
    """Match one frame's detections with its truth at several thresholds at once.

    Each detection takes the free truth object of its class group with the largest IoU, if that reaches the
    threshold. An object that is asked for is preferred to one that isn't, whatever their IoU; a detection that finds
    neither may lie in an ignored region, which never fills up.

    Args:
        detections: Of one frame.
        truth_boxes: [N, 4] xyxy in pixels.
        truth_class_ids: int32 [N], contiguous COCO-80 indices.
        iou_thresholds: [T], least IoU of a match.
        counted: bool [N], False for objects that are not asked for; all are by default.
        ignored_boxes: [M, 4] xyxy in pixels, regions that nobody annotated, of any class.
        region_shares: [T], least share of a detection inside an ignored region; ``IGNORED_REGION_SHARE`` by default.
            COCO's ``iscrowd`` rule takes the IoU thresholds themselves.
    """
    detection_groups = group_indices(detections.class_ids)
    order = np.argsort(-detections.scores, kind="stable")
    order = order[detection_groups[order] >= 0]
    groups = detection_groups[order]
    truth_groups = group_indices(truth_class_ids)
    asked = truth_groups >= 0
    if counted is not None:
        asked = asked & np.asarray(counted, np.bool_)
    thresholds = np.asarray(iou_thresholds, np.float64)
    shares = np.full(len(thresholds), IGNORED_REGION_SHARE) if region_shares is None else np.asarray(region_shares)
    boxes = detections.boxes_xyxy[order]
    # -1 is below every threshold: objects of another group are out of reach.
    overlaps = np.where(groups[:, None] == truth_groups[None, :], box_iou(boxes, truth_boxes), -1.0)
    inside = np.zeros(len(order)) if ignored_boxes is None else inside_share(boxes, ignored_boxes)
    in_region = inside[None, :] >= shares[:, None]
    correct = np.zeros((len(thresholds), len(order)), np.bool_)
    excused = in_region.copy()
    free = np.ones((len(thresholds), len(truth_groups)), np.bool_)
    # The many detections that touch nothing need no step of their own.
    for place in np.flatnonzero((overlaps >= thresholds.min(initial=np.inf)).any(axis=1)):
        reach = np.where(free & (overlaps[place] >= thresholds[:, None]), overlaps[place], -1.0)
        found, best, _ = best_of(reach, asked)
        claimed, second, overlap = best_of(reach, ~asked)
        claimed &= ~found & ~(in_region[:, place] & (inside[place] > overlap))
        free[found, best[found]] = False
        free[claimed, second[claimed]] = False
        correct[:, place] = found
        excused[:, place] = ~found & (claimed | in_region[:, place])
    return FrameMatches(
        detections.scores[order], groups, correct, excused, np.bincount(truth_groups[asked], minlength=len(GROUPS))
    )


def best_of(
    reach: Float64Array, candidates: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64], Float64Array]:
    """The candidate of largest IoU at each threshold.

    Args:
        reach: [T, N], IoU of the objects within reach, -1 for the others.
        candidates: bool [N].

    Returns:
        Whether there is one, bool [T]; its row, int64 [T]; its IoU, float64 [T], -1 where there is none.
    """
    rows = np.flatnonzero(candidates)
    if not len(rows):
        nothing = len(reach)
        return np.zeros(nothing, np.bool_), np.zeros(nothing, np.int64), np.full(nothing, -1.0)
    places = reach[:, rows].argmax(axis=1)
    overlap: Float64Array = reach[np.arange(len(reach)), rows[places]]
    return overlap >= 0.0, rows[places], overlap


def match_detections(
    detections: Detections,
    truth_boxes: Float32Array,
    truth_class_ids: Int32Array,
    iou_threshold: float = 0.5,
    *,
    counted: npt.NDArray[np.bool_] | None = None,
    ignored_boxes: Float32Array | None = None,
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
        ignored_boxes: float32 [M, 4], regions that nobody annotated; a detection without a match of which at least
            half lies in one of them is neither right nor wrong.

    Returns:
        The counts of this frame.
    """
    matches = match_frame(
        detections, truth_boxes, truth_class_ids, (iou_threshold,), counted=counted, ignored_boxes=ignored_boxes
    )
    right, wrong, missed = matches.counts()[0].sum(axis=0).tolist()
    return MatchCounts(right, wrong, missed)


def without_counterpart(these: Detections, others: Detections, iou_threshold: float = 0.5) -> npt.NDArray[np.bool_]:
    """Which detections no other of their class group overlaps by the threshold, bool [len(these)].

    Nothing is assigned, so two of them may have the same counterpart: for pictures, not for counts.
    """
    groups = [[CLASS_GROUPS.get(int(index), str(index)) for index in which.class_ids] for which in (these, others)]
    alike = np.array(groups[0])[:, None] == np.array(groups[1])[None, :]
    reached = (box_iou(these.boxes_xyxy, others.boxes_xyxy) >= iou_threshold) & alike
    return ~reached.any(axis=1)
