"""A detector whose last detections are remembered, weak ones included, which average precision needs."""

from __future__ import annotations

from collections.abc import Sequence

from cable_rpc.cloud.backends import Detector, RegionDetector
from cable_rpc.types import BoolMask, Detections, Image

WEAKEST_SCORE = 0.05
"""Least score that takes part in average precision."""


class ScoreKeeper:
    """Passes on what a detector finds, and keeps it; a session drops what is weaker than it asks for.

    Args:
        detector: opened with a threshold of `WEAKEST_SCORE`.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
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
        return found
