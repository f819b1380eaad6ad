"""What a batch of frames asks of a detector and of a segmenter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cable_rpc.cloud.backends import BatchSegmenter, Detector, RegionDetector, SegmentationRequest, Segmenter
from cable_rpc.errors import ModelError
from cable_rpc.types import BoolMask, Detections, Image, Segmentation


@dataclass(frozen=True, slots=True)
class DetectionRequest:
    """A picture for the detector."""

    image: Image
    """uint8 [H, W, 3] BGR."""
    roi: BoolMask | None
    """bool [H, W]; None = the whole frame."""


def detect_batch(detector: Detector, requests: Sequence[DetectionRequest]) -> list[Detections]:
    """Boxes of each picture; a detector that can look at regions closely is told which."""
    images = [request.image for request in requests]
    regions = [request.roi for request in requests]
    # Asked last: a look at a protocol's members takes longer than the rest of this.
    if any(region is not None for region in regions) and isinstance(detector, RegionDetector):
        return detector.detect_regions(images, regions)
    return detector.detect(images)


def segment_batch(segmenter: Segmenter, requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
    """M_k = F(I~_k, p) of each picture, intersected with its R_k.

    Raises:
        ModelError: the segmenter's uncertainty is not uint8 of the picture's size.
    """
    if isinstance(segmenter, BatchSegmenter):
        answers = segmenter.segment_batch(requests)
    else:
        answers = [segmenter.segment(asked.image, asked.roi, asked.prompt, asked.context) for asked in requests]
    return [_inside(segmenter.name, answer, asked.roi) for answer, asked in zip(answers, requests, strict=True)]


def _inside(name: str, answer: Segmentation, roi: BoolMask) -> Segmentation:
    """An answer inside its region; outside nothing is known, so there is no uncertainty either."""
    uncertainty = answer.uncertainty
    if uncertainty is not None and (uncertainty.shape != roi.shape or uncertainty.dtype != np.uint8):
        raise ModelError(
            f"segmenter {name} must state its uncertainty as uint8 {list(roi.shape)}, got "
            f"{uncertainty.dtype} {list(uncertainty.shape)}"
        )
    if roi.all():
        return answer
    known = None if uncertainty is None else np.where(roi, uncertainty, np.uint8(0))
    return replace(answer, mask=answer.mask & roi, uncertainty=known)
