"""One sequence under one strategy: the sums that every figure is made of; JSON both ways."""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import BYTE_LAYERS, RECOGNITION_THRESHOLDS, RankedMatches
from cable_rpc.study.sequence_metrics.costs import CoverageTally, KeyframeTally, LayerTally, MaskTally, PrefillTally
from cable_rpc.study.sequence_metrics.perception import (
    COUNTS_SHAPE,
    FRAME_SCORES_SHAPE,
    RECOGNITION_SHAPE,
    RETENTION_IOUS,
    DetectionTally,
    Int64Array,
    Picture,
    RecognitionTally,
)
from cable_rpc.study.sequence_metrics.storage import counts_of, ranked_from_json, ranked_to_json, shaped

SCHEMA_VERSION = 1
"""Changes with every change of the shape or meaning of what is stored."""

RankedKey = tuple[Picture, str]


@dataclass(frozen=True, slots=True)
class SequenceMetrics:
    """Everything that pooling needs of one sequence; a few kB, and some bytes for every detection and stage time."""

    name: str
    fps: float | None
    """Nominal frame rate; None where no rate in kbit/s is wanted."""
    truth_frames: int
    """Annotated frames."""
    keyframes: KeyframeTally
    coverage_roi: CoverageTally
    """R_k over all frames but the first, keyframes by their R_k."""
    coverage_tx: CoverageTally
    """What was sent, keyframes and the first frame as 1."""
    prefill: PrefillTally
    masks: MaskTally
    layers: tuple[LayerTally, ...]
    """In the order of ``BYTE_LAYERS``."""
    recognition: RecognitionTally
    detection: DetectionTally
    ranked: Mapping[RankedKey, tuple[RankedMatches, ...]]
    """For AP: by picture and truth variant, one entry per class group."""
    retention: Int64Array
    """int64 [len(RETENTION_IOUS), 3]: retained, reference, spurious."""
    staleness: Mapping[int, int]
    """Frames by the age of their prior."""
    stage_ns: Mapping[str, tuple[int, ...]]
    """Durations by stage of the frames that have it."""
    end_to_end_ns: tuple[int, ...]

    @property
    def frames(self) -> int:
        """All frames."""
        return self.keyframes.frames

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values; scores and match flags are packed, the rest is readable."""
        return {
            "schema_version": SCHEMA_VERSION,
            "name": self.name,
            "fps": self.fps,
            "truth_frames": self.truth_frames,
            "keyframes": asdict(self.keyframes),
            "coverage_roi": asdict(self.coverage_roi),
            "coverage_tx": asdict(self.coverage_tx),
            "prefill": asdict(self.prefill),
            "masks": asdict(self.masks),
            "layers": {layer: asdict(tally) for layer, tally in zip(BYTE_LAYERS, self.layers, strict=True)},
            "recognition": {"objects": self.recognition.objects.tolist(), "hits": self.recognition.hits.tolist()},
            "detection": {
                "counts": self.detection.counts.tolist(),
                "frame_scores": self.detection.frame_scores.tolist(),
                "scored_frames": self.detection.scored_frames.tolist(),
            },
            "ranked": [
                {"picture": picture, "variant": variant, "groups": [ranked_to_json(group) for group in groups]}
                for (picture, variant), groups in self.ranked.items()
            ],
            "retention": self.retention.tolist(),
            "staleness": [list(pair) for pair in self.staleness.items()],
            "stage_ns": {stage: list(sample) for stage, sample in self.stage_ns.items()},
            "end_to_end_ns": list(self.end_to_end_ns),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> SequenceMetrics:
        """The inverse of `to_json`.

        Raises:
            ConfigurationError: another version wrote it, or it does not hold a sequence's metrics.
        """
        version = content.get("schema_version")
        if version != SCHEMA_VERSION:
            raise ConfigurationError(
                f"these metrics have schema version {version}, this program reads {SCHEMA_VERSION}: measure again"
            )
        try:
            return cls(
                name=str(content["name"]),
                fps=None if content["fps"] is None else float(content["fps"]),
                truth_frames=int(content["truth_frames"]),
                keyframes=KeyframeTally(**content["keyframes"]),
                coverage_roi=CoverageTally(**content["coverage_roi"]),
                coverage_tx=CoverageTally(**content["coverage_tx"]),
                prefill=PrefillTally(**content["prefill"]),
                masks=MaskTally(**content["masks"]),
                layers=tuple(LayerTally(**content["layers"][layer]) for layer in BYTE_LAYERS),
                recognition=RecognitionTally(
                    counts_of(content["recognition"]["objects"], RECOGNITION_SHAPE),
                    counts_of(content["recognition"]["hits"], (*RECOGNITION_SHAPE, len(RECOGNITION_THRESHOLDS))),
                ),
                detection=DetectionTally(
                    counts_of(content["detection"]["counts"], COUNTS_SHAPE),
                    shaped(np.array(content["detection"]["frame_scores"], np.float64), FRAME_SCORES_SHAPE),
                    counts_of(content["detection"]["scored_frames"], FRAME_SCORES_SHAPE),
                ),
                ranked={
                    (entry["picture"], entry["variant"]): tuple(map(ranked_from_json, entry["groups"]))
                    for entry in content["ranked"]
                },
                retention=counts_of(content["retention"], (len(RETENTION_IOUS), 3)),
                staleness={int(age): int(count) for age, count in content["staleness"]},
                stage_ns={stage: tuple(map(int, sample)) for stage, sample in content["stage_ns"].items()},
                end_to_end_ns=tuple(map(int, content["end_to_end_ns"])),
            )
        except (KeyError, TypeError, ValueError, AttributeError, binascii.Error, zlib.error) as error:
            raise ConfigurationError(
                f"this does not hold a sequence's metrics ({error!r}): measure it again"
            ) from error
