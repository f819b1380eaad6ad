"""Segmenters that need no language model: two baselines, one below and one above the real thing."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from cable_rpc.cloud.backends import BackendOptions, FrameContext
from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import BoolMask, Frame, Image, Segmentation


class BoxSegmenter:
    """The detector's boxes, filled: the paper's detection-based alternative to a language model."""

    name = "boxes"
    revision = "1"
    device = "cpu"

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """Union of the boxes, each pixel as sure as the best of its boxes.

        The confidence is the mean score, 1 where nothing was found; the uncertainty of a pixel 255 (1 - score), 0
        outside the boxes.
        """
        height, width = image.shape[:2]
        mask = np.zeros((height, width), np.bool_)
        uncertainty = np.zeros((height, width), np.uint8)
        scores = context.detections.scores
        doubts = np.rint(255.0 * (1.0 - scores.astype(np.float64).clip(0.0, 1.0))).astype(np.uint8)
        boxes = context.detections.boxes_xyxy
        x_min, y_min = np.floor(boxes[:, :2]).clip(0).astype(int).T
        x_max, y_max = np.ceil(boxes[:, 2:]).clip(0).astype(int).T
        # The best box is painted last.
        for box in np.argsort(scores, kind="stable"):
            inside = np.s_[y_min[box] : y_max[box], x_min[box] : x_max[box]]
            mask[inside] = True
            uncertainty[inside] = doubts[box]
        confidence = float(scores.mean()) if len(scores) else 1.0
        return Segmentation(mask, confidence, uncertainty=uncertainty)


@runtime_checkable
class RandomAccessSource(Protocol):
    """A source whose frames can be asked for by number."""

    def frame(self, index: int) -> Frame:
        """The frame with this number."""
        ...


class OracleSegmenter:
    """Ground truth of a source that the server can open itself: an upper bound for evaluation, never a default."""

    revision = "1"
    device = "cpu"

    def __init__(self, spec: str) -> None:
        self.name = f"oracle:{spec}"
        source = open_source(spec)
        if not isinstance(source, RandomAccessSource):
            raise ConfigurationError(
                f"the oracle needs a source with random access and ground truth, '{spec}' has none; "
                "use oracle:synthetic:SEED"
            )
        self._source = source

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """Visible pixels of all annotated objects of the frame with this sequence number.

        Raises:
            FrameError: if the source has no such frame, no masks, or another frame size.
        """
        frame = self._source.frame(context.sequence)
        if frame.size_hw != image.shape[:2]:
            raise FrameError(
                f"{self.name} renders {frame.size_hw[1]}x{frame.size_hw[0]}, the stream is "
                f"{image.shape[1]}x{image.shape[0]}; give both ends the same source and size"
            )
        if frame.truth is None or frame.truth.instance_mask is None:
            raise FrameError(f"{self.name} has no instance masks")
        return Segmentation(frame.truth.instance_mask > 0, 1.0)


def load_boxes(argument: str, options: BackendOptions) -> BoxSegmenter:
    """Entry point ``boxes``."""
    if argument:
        raise ConfigurationError(f"the boxes segmenter takes no argument, got '{argument}'")
    return BoxSegmenter()


def load_oracle(argument: str, options: BackendOptions) -> OracleSegmenter:
    """Entry point ``oracle:SOURCE``."""
    if not argument:
        raise ConfigurationError("the oracle needs the source it knows: --segmenter oracle:synthetic:SEED")
    return OracleSegmenter(argument)
