"""A detector whose weak detections are remembered for average precision, and kept from everyone else."""

from __future__ import annotations

from collections.abc import Sequence

from cable_rpc.cloud.backends import Detector, RegionDetector
from cable_rpc.types import BoolMask, Detections, Image

WEAKEST_SCORE = 0.05
"""Least score that takes part in average precision."""


class ScoreKeeper:
    """Passes on what a detector is sure of, as it would answer with that threshold, and keeps all it found.

    Args:
        detector: opened with a threshold of `WEAKEST_SCORE`.
        min_score: the threshold of what is passed on.
    """

    def __init__(self, detector: Detector, min_score: float) -> None:
        self._detector = detector
        self._min_score = min_score
        self.name = detector.name
        self.revision = detector.revision
        self.device = detector.device
        self.newest = Detections.empty()
        """All of the last picture, weak ones included."""
        self.picture: Image | None = None
        """The last picture, as decoded."""

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        """See `Detector`."""
        return self._kept(images, self._detector.detect(images))

    def detect_regions(self, images: Sequence[Image], regions: Sequence[BoolMask | None]) -> list[Detections]:
        """See `RegionDetector`; a detector that is none sees the whole pictures."""
        if isinstance(self._detector, RegionDetector):
            return self._kept(images, self._detector.detect_regions(images, regions))
        return self.detect(images)

    def _kept(self, images: Sequence[Image], found: list[Detections]) -> list[Detections]:
        if found:
            self.newest, self.picture = found[-1], images[-1]
        return [one.select(one.scores >= self._min_score) for one in found]
