"""Segmenters that need no language model: two baselines, one below and one above the real thing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from cable_rpc.cloud.backends import BackendOptions, FrameContext
from cable_rpc.cloud.spec_options import meaning, read_options
from cable_rpc.data.source import open_source
from cable_rpc.errors import ConfigurationError, FrameError
from cable_rpc.types import BoolMask, Detections, Frame, Image, Segmentation


@dataclass(frozen=True, slots=True)
class BoxOptions:
    """What a user may ask of `BoxSegmenter`."""

    min_score: float | None = meaning(
        "also boxes below the session's threshold, from this score on: a doubtful object is worth a closer look. The "
        "detector must tell them (onnx:FILE?min_score=0.2)"
    )


class BoxSegmenter:
    """The detector's boxes, filled: the paper's detection-based alternative to a language model.

    Args:
        min_score: boxes below the session's threshold take part from this score on; None leaves them out.
    """

    name = "boxes"
    revision = "1"
    device = "cpu"

    def __init__(self, min_score: float | None = None) -> None:
        if min_score is not None and not 0.0 <= min_score <= 1.0:
            raise ConfigurationError(f"the boxes segmenter's min_score must be 0..1, got {min_score}")
        self._min_score = min_score

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """Union of the boxes, each pixel as sure as the best of its boxes.

        The confidence is the mean score of what the session asks for, 1 where nothing was found; the uncertainty of a
        pixel 255 (1 - score), 0 outside the boxes.
        """
        height, width = image.shape[:2]
        mask = np.zeros((height, width), np.bool_)
        uncertainty = np.zeros((height, width), np.uint8)
        detections = self._taken(context)
        scores = detections.scores
        doubts = np.rint(255.0 * (1.0 - scores.astype(np.float64).clip(0.0, 1.0))).astype(np.uint8)
        boxes = detections.boxes_xyxy
        x_min, y_min = np.floor(boxes[:, :2]).clip(0).astype(int).T
        x_max, y_max = np.ceil(boxes[:, 2:]).clip(0).astype(int).T
        # The best box is painted last.
        for box in np.argsort(scores, kind="stable"):
            inside = np.s_[y_min[box] : y_max[box], x_min[box] : x_max[box]]
            mask[inside] = True
            uncertainty[inside] = doubts[box]
        sure = context.detections.scores
        confidence = float(sure.mean()) if len(sure) else 1.0
        return Segmentation(mask, confidence, uncertainty=uncertainty)

    def _taken(self, context: FrameContext) -> Detections:
        """The boxes that make the mask."""
        sure, doubtful = context.detections, context.doubtful
        if self._min_score is None or doubtful is None:
            return sure
        taken = doubtful.select(doubtful.scores >= self._min_score)
        return Detections(
            np.concatenate([sure.boxes_xyxy, taken.boxes_xyxy]),
            np.concatenate([sure.class_ids, taken.class_ids]),
            np.concatenate([sure.scores, taken.scores]),
        )


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
    """Entry point ``boxes[?min_score=SCORE]``."""
    rest, _, query = argument.partition("?")
    if rest:
        raise ConfigurationError(f"the boxes segmenter takes no argument but options, got '{argument}'")
    (given,) = read_options(f"boxes{argument}", query, BoxOptions)
    return BoxSegmenter(BoxOptions(**given).min_score)


def load_oracle(argument: str, options: BackendOptions) -> OracleSegmenter:
    """Entry point ``oracle:SOURCE``."""
    if not argument:
        raise ConfigurationError("the oracle needs the source it knows: --segmenter oracle:synthetic:SEED")
    return OracleSegmenter(argument)
