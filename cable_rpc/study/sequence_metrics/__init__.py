"""From measured frames to the figures of a sequence and of a data set.

`measure_sequence` (or a `SequenceMeter`, frame by frame) gives `SequenceMetrics`, sums that are small, exact and go
through JSON; `pool` joins those of a data set to `DatasetMetrics`, which answers for every figure, by the paper's
definition and by the stricter headline.
"""

from cable_rpc.study.metrics import Bootstrap, ByteLayers, Interval, MaskOverlap, mask_overlap, roi_overlap
from cable_rpc.study.sequence_metrics.dataset import (
    DatasetMetrics,
    LayerRates,
    ScoreEstimates,
    paired_difference,
    pool,
)
from cable_rpc.study.sequence_metrics.estimates import AP_FIGURES, Estimate
from cable_rpc.study.sequence_metrics.figures import FIGURES, Figure
from cable_rpc.study.sequence_metrics.frame import FramePrefill, MeasuredFrame, frame_prefill
from cable_rpc.study.sequence_metrics.meter import SequenceMeter, measure_sequence
from cable_rpc.study.sequence_metrics.perception import IOU_THRESHOLDS, OPERATING_SCORE
from cable_rpc.study.sequence_metrics.sequence import SequenceMetrics

__all__ = [
    "AP_FIGURES",
    "FIGURES",
    "IOU_THRESHOLDS",
    "OPERATING_SCORE",
    "Bootstrap",
    "ByteLayers",
    "DatasetMetrics",
    "Estimate",
    "Figure",
    "FramePrefill",
    "Interval",
    "LayerRates",
    "MaskOverlap",
    "MeasuredFrame",
    "ScoreEstimates",
    "SequenceMeter",
    "SequenceMetrics",
    "frame_prefill",
    "mask_overlap",
    "measure_sequence",
    "paired_difference",
    "pool",
    "roi_overlap",
]
