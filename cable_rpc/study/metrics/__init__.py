"""Numbers that say how well a frame was perceived and how much of it was sent; pure functions over arrays."""

from cable_rpc.study.metrics.average_precision import (
    AP_IOU_THRESHOLDS,
    RankedMatches,
    average_precision,
    join_matches,
    ranked_matches,
)
from cable_rpc.study.metrics.bootstrap import (
    Bootstrap,
    Interval,
    bootstrap_interval,
    drawn_ratios,
)
from cable_rpc.study.metrics.coverage import BYTE_LAYERS, ByteLayers, pixel_saving, sent_coverage
from cable_rpc.study.metrics.masks import MaskOverlap, mask_iou, mask_overlap
from cable_rpc.study.metrics.matching import (
    FrameMatches,
    MatchCounts,
    box_iou,
    inside_share,
    match_detections,
    match_frame,
    without_counterpart,
)
from cable_rpc.study.metrics.recognition import (
    RECOGNITION_THRESHOLDS,
    reached_levels,
    recognition_curve,
    roi_overlap,
)
from cable_rpc.study.metrics.retention import RetentionCounts, retained
from cable_rpc.study.metrics.scores import Scores, macro_frame, scores_of
from cable_rpc.study.metrics.statistics import Percentiles, mean_or_none, percentiles
from cable_rpc.study.metrics.truth_selection import (
    GROUPS,
    SIZE_BINS,
    TRUTH_VARIANTS,
    TruthVariant,
    asked_truth,
    group_indices,
    size_bins,
    visible_truth,
)

__all__ = [
    "AP_IOU_THRESHOLDS",
    "BYTE_LAYERS",
    "GROUPS",
    "RECOGNITION_THRESHOLDS",
    "SIZE_BINS",
    "TRUTH_VARIANTS",
    "Bootstrap",
    "ByteLayers",
    "FrameMatches",
    "Interval",
    "MaskOverlap",
    "MatchCounts",
    "Percentiles",
    "RankedMatches",
    "RetentionCounts",
    "Scores",
    "TruthVariant",
    "asked_truth",
    "average_precision",
    "bootstrap_interval",
    "box_iou",
    "drawn_ratios",
    "group_indices",
    "inside_share",
    "join_matches",
    "macro_frame",
    "mask_iou",
    "mask_overlap",
    "match_detections",
    "match_frame",
    "mean_or_none",
    "percentiles",
    "pixel_saving",
    "ranked_matches",
    "reached_levels",
    "recognition_curve",
    "retained",
    "roi_overlap",
    "scores_of",
    "sent_coverage",
    "size_bins",
    "visible_truth",
    "without_counterpart",
]
