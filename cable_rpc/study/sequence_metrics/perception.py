"""What a sequence's frames add up to in recognition, detection and retention; all of it adds over sequences too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics import (
    AP_IOU_THRESHOLDS,
    GROUPS,
    RECOGNITION_THRESHOLDS,
    SIZE_BINS,
    TRUTH_VARIANTS,
    FrameMatches,
    MatchCounts,
    RankedMatches,
    asked_truth,
    group_indices,
    match_frame,
    ranked_matches,
    reached_levels,
    retained,
    scores_of,
    size_bins,
)
from cable_rpc.study.sequence_metrics.frame import MeasuredFrame
from cable_rpc.types import Detections, GroundTruth

Int64Array = npt.NDArray[np.int64]
Float64Array = npt.NDArray[np.float64]

Region = Literal["roi", "sent"]
Picture = Literal["roi", "full"]

REGIONS: tuple[Region, ...] = ("roi", "sent")
"""R_k as predicted (the paper's, keyframes by their R_k), and what was sent (keyframes whole)."""
PICTURES: tuple[Picture, ...] = ("roi", "full")
"""Detections on the received frame, and on the whole one."""
OPERATING_SCORE = 0.4
"""Least score of a detection that counts in precision, recall and retention (paper, section IV)."""
IOU_THRESHOLDS = (0.3, *AP_IOU_THRESHOLDS)
"""Thresholds at which detections are counted; the paper's is 0.5."""
AP_ROWS = slice(1, None)
"""Those of ``IOU_THRESHOLDS`` that AP is made of."""
RETENTION_IOUS = (0.5, 0.75)
"""Thresholds of retention; the paper's is the first."""

RECOGNITION_SHAPE = (len(REGIONS), len(TRUTH_VARIANTS), len(GROUPS), len(SIZE_BINS))
COUNTS_SHAPE = (len(PICTURES), len(TRUTH_VARIANTS), len(IOU_THRESHOLDS), len(GROUPS), 3)
FRAME_SCORES_SHAPE = (len(PICTURES), len(TRUTH_VARIANTS), len(IOU_THRESHOLDS), 3)


@dataclass(frozen=True, slots=True)
class RecognitionTally:
    """Objects, and those of them that a region held; axes region, truth variant, class group, size bin."""

    objects: Int64Array
    """int64 [R, V, G, B]."""
    hits: Int64Array
    """int64 [R, V, G, B, len(RECOGNITION_THRESHOLDS)]."""

    @classmethod
    def empty(cls) -> RecognitionTally:
        """Nothing yet."""
        return cls(
            np.zeros(RECOGNITION_SHAPE, np.int64), np.zeros((*RECOGNITION_SHAPE, len(RECOGNITION_THRESHOLDS)), np.int64)
        )

    def __add__(self, other: RecognitionTally) -> RecognitionTally:
        return RecognitionTally(self.objects + other.objects, self.hits + other.hits)


@dataclass(frozen=True, slots=True)
class DetectionTally:
    """Matches with truth; axes picture, truth variant, IoU threshold, class group."""

    counts: Int64Array
    """int64 [P, V, T, G, 3], true and false positives, false negatives of detections from ``OPERATING_SCORE``."""
    frame_scores: Float64Array
    """float64 [P, V, T, 3], sums over frames of their precision, recall and F1 over all groups."""
    scored_frames: Int64Array
    """int64 [P, V, T, 3], frames in which each is defined."""

    @classmethod
    def empty(cls) -> DetectionTally:
        """Nothing yet."""
        return cls(
            np.zeros(COUNTS_SHAPE, np.int64), np.zeros(FRAME_SCORES_SHAPE), np.zeros(FRAME_SCORES_SHAPE, np.int64)
        )

    def __add__(self, other: DetectionTally) -> DetectionTally:
        return DetectionTally(
            self.counts + other.counts,
            self.frame_scores + other.frame_scores,
            self.scored_frames + other.scored_frames,
        )


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """One frame's share of a sequence's detection figures."""

    tally: DetectionTally
    ranked: dict[tuple[Picture, str], tuple[RankedMatches, ...]]
    """By picture and truth variant, one entry per class group."""


def recognition_of(frame: MeasuredFrame, truth: GroundTruth, *, first: bool) -> RecognitionTally:
    """One annotated frame's objects; a sequence's first frame has no R_k."""
    tally = RecognitionTally.empty()
    groups, sizes = group_indices(truth.class_ids), size_bins(truth)
    overlaps = (None if first else frame.overlap_roi, frame.overlap_sent)
    for region, overlap in enumerate(overlaps):
        if overlap is None:
            continue
        reached = reached_levels(np.asarray(overlap, np.float64))
        for place, variant in enumerate(TRUTH_VARIANTS):
            rows = np.flatnonzero(asked_truth(truth, variant))
            np.add.at(tally.objects[region, place], (groups[rows], sizes[rows]), 1)
            np.add.at(tally.hits[region, place], (groups[rows], sizes[rows]), reached[:, rows].T)
    return tally


def detections_of(frame: MeasuredFrame, truth: GroundTruth) -> FrameDetections:
    """One annotated frame's matches."""
    tally = DetectionTally.empty()
    ranked: dict[tuple[Picture, str], tuple[RankedMatches, ...]] = {}
    pictures: tuple[tuple[Picture, Detections], ...] = (("roi", frame.detections), ("full", frame.full_detections))
    for p, (picture, detections) in enumerate(pictures):
        for v, variant in enumerate(TRUTH_VARIANTS):
            asked = asked_truth(truth, variant)
            matches = matched(detections, truth, asked, IOU_THRESHOLDS)
            counts = matches.counts(OPERATING_SCORE)
            tally.counts[p, v] = counts
            for t, (right, wrong, missed) in enumerate(counts.sum(axis=1).tolist()):
                scores = scores_of(MatchCounts(right, wrong, missed))
                for s, score in enumerate((scores.precision, scores.recall, scores.f1)):
                    if score is not None:
                        tally.frame_scores[p, v, t, s] = score
                        tally.scored_frames[p, v, t, s] = 1
            ranked[picture, variant] = ranked_matches(
                matches.at(AP_ROWS)
                if truth.ignored_boxes_xyxy is None
                else matched(detections, truth, asked, AP_IOU_THRESHOLDS, region_shares=AP_IOU_THRESHOLDS)
            )
    return FrameDetections(tally, ranked)


def matched(
    detections: Detections,
    truth: GroundTruth,
    asked: npt.NDArray[np.bool_],
    thresholds: tuple[float, ...],
    region_shares: tuple[float, ...] | None = None,
) -> FrameMatches:
    """`metrics.match_frame` over an annotated frame."""
    return match_frame(
        detections,
        truth.boxes_xyxy,
        truth.class_ids,
        thresholds,
        counted=asked,
        ignored_boxes=truth.ignored_boxes_xyxy,
        region_shares=region_shares,
    )


def retention_of(frame: MeasuredFrame) -> Int64Array:
    """Retained, reference and spurious detections at each of ``RETENTION_IOUS``, int64 [len(RETENTION_IOUS), 3]."""
    whole = frame.full_detections.select(frame.full_detections.scores >= OPERATING_SCORE)
    ours = frame.detections.select(frame.detections.scores >= OPERATING_SCORE)
    counts = [retained(whole, ours, iou) for iou in RETENTION_IOUS]
    return np.array([[one.retained, one.reference_count, one.spurious] for one in counts], np.int64)
