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
        """Union of the boxes; the confidence is the mean score, 1 where nothing was found."""
        height, width = image.shape[:2]
        mask = np.zeros((height, width), np.bool_)
        boxes = context.detections.boxes_xyxy
        x_min, y_min = np.floor(boxes[:, :2]).clip(0).astype(int).T
        x_max, y_max = np.ceil(boxes[:, 2:]).clip(0).astype(int).T
        for left, top, right, bottom in zip(x_min, y_min, x_max, y_max, strict=True):
            mask[top:bottom, left:right] = True
        scores = context.detections.scores
        return Segmentation(mask, float(scores.mean()) if len(scores) else 1.0)


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
