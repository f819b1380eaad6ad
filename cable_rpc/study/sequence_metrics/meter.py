"""Frame by frame to the metrics of a sequence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from cable_rpc.study.metrics import BYTE_LAYERS, TRUTH_VARIANTS, RankedMatches, join_matches
from cable_rpc.study.sequence_metrics.costs import (
    CoverageTally,
    KeyframeTally,
    LayerTally,
    MaskTally,
    PrefillTally,
    add_layers,
    coverages_of,
    keyframes_of,
    layers_of,
    masks_of,
    prefill_of,
)
from cable_rpc.study.sequence_metrics.frame import MeasuredFrame
from cable_rpc.study.sequence_metrics.perception import (
    PICTURES,
    RETENTION_IOUS,
    DetectionTally,
    Int64Array,
    RecognitionTally,
    detections_of,
    recognition_of,
    retention_of,
)
from cable_rpc.study.sequence_metrics.sequence import RankedKey, SequenceMetrics


@dataclass(slots=True)
class SequenceMeter:
    """Adds up the frames of one sequence as they come; holds no frame.

    Frames have to come in order: the first is the sequence's k = 0.
    """

    name: str = ""
    fps: float | None = None
    truth_frames: int = 0
    keyframes: KeyframeTally = field(default_factory=KeyframeTally)
    coverage_roi: CoverageTally = field(default_factory=CoverageTally)
    coverage_tx: CoverageTally = field(default_factory=CoverageTally)
    prefill: PrefillTally = field(default_factory=PrefillTally)
    masks: MaskTally = field(default_factory=MaskTally)
    layers: tuple[LayerTally, ...] = field(default_factory=lambda: (LayerTally(),) * len(BYTE_LAYERS))
    recognition: RecognitionTally = field(default_factory=RecognitionTally.empty)
    detection: DetectionTally = field(default_factory=DetectionTally.empty)
    ranked: dict[RankedKey, list[tuple[RankedMatches, ...]]] = field(default_factory=dict)
    retention: Int64Array = field(default_factory=lambda: np.zeros((len(RETENTION_IOUS), 3), np.int64))
    staleness: dict[int, int] = field(default_factory=dict)
    stage_ns: dict[str, list[int]] = field(default_factory=dict)
    end_to_end_ns: list[int] = field(default_factory=list)

    def add(self, frame: MeasuredFrame) -> None:
        """The next frame."""
        first = self.keyframes.frames == 0
        roi, sent = coverages_of(frame, first=first)
        self.keyframes += keyframes_of(frame, first=first)
        self.coverage_roi += roi
        self.coverage_tx += sent
        self.prefill += prefill_of(frame)
        self.masks += masks_of(frame)
        self.layers = add_layers(self.layers, layers_of(frame))
        self.retention = self.retention + retention_of(frame)
        if frame.truth is not None:
            self.truth_frames += 1
            self.recognition += recognition_of(frame, frame.truth, first=first)
            found = detections_of(frame, frame.truth)
            self.detection += found.tally
            for key, groups in found.ranked.items():
                self.ranked.setdefault(key, []).append(groups)
        if frame.staleness is not None:
            self.staleness[frame.staleness] = self.staleness.get(frame.staleness, 0) + 1
        for stage, duration_ns in frame.stage_ns.items():
            self.stage_ns.setdefault(stage, []).append(int(duration_ns))
        if frame.end_to_end_ns is not None:
            self.end_to_end_ns.append(int(frame.end_to_end_ns))

    def metrics(self) -> SequenceMetrics:
        """The sums so far."""
        ranked: dict[RankedKey, tuple[RankedMatches, ...]] = {
            (picture, variant): tuple(map(join_matches, zip(*self.ranked[picture, variant], strict=True)))
            for picture in PICTURES
            for variant in TRUTH_VARIANTS
            if (picture, variant) in self.ranked
        }
        return SequenceMetrics(
            name=self.name,
            fps=self.fps,
            truth_frames=self.truth_frames,
            keyframes=self.keyframes,
            coverage_roi=self.coverage_roi,
            coverage_tx=self.coverage_tx,
            prefill=self.prefill,
            masks=self.masks,
            layers=self.layers,
            recognition=self.recognition,
            detection=self.detection,
            ranked=ranked,
            retention=self.retention,
            staleness=dict(sorted(self.staleness.items())),
            stage_ns={stage: tuple(sample) for stage, sample in self.stage_ns.items()},
            end_to_end_ns=tuple(self.end_to_end_ns),
        )


def measure_sequence(frames: Iterable[MeasuredFrame], *, name: str = "", fps: float | None = None) -> SequenceMetrics:
    """Metrics of one sequence, whose frames come in order; they are taken one at a time.

    Args:
        frames: from k = 0 on.
        name: of the sequence; pairs it with itself under another strategy.
        fps: nominal frame rate, for rates in kbit/s.
    """
    meter = SequenceMeter(name, fps)
    for frame in frames:
        meter.add(frame)
    return meter.metrics()
