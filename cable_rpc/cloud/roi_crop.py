"""A segmenter shown only the box around the region: it needs nothing of the model, so closed ones profit too.

A fixed-size model (LISA's CLIP tower, a closed cloud model behind an API) spends its tokens and pixels on the crop
alone, so that small road users are seen larger; a model whose cost grows with the picture becomes cheaper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cable_rpc.cloud.backends import BackendOptions, FrameContext, Segmenter, load_segmenter
from cable_rpc.cloud.spec_options import read_options
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import BoolMask, Detections, Image, Segmentation


@dataclass(frozen=True, slots=True)
class CropOptions:
    """How the box around a region becomes the picture that is shown."""

    margin: int = field(default=32, metadata={"help": "context around the region's box, pixels"})
    min_side: int = field(default=224, metadata={"help": "shortest side, pixels, as far as the frame reaches"})
    max_aspect: float = field(
        default=2.0, metadata={"help": "longer by shorter side at most, as far as the frame reaches"}
    )
    align: int = field(
        default=32, metadata={"help": "at last the box grows to multiples of this, pixels, so that it seldom moves"}
    )

    def __post_init__(self) -> None:
        for name, lowest in (("margin", 0), ("align", 1), ("min_side", 1), ("max_aspect", 1.0)):
            if not getattr(self, name) >= lowest:
                raise ConfigurationError(f"{name} is {getattr(self, name)}; give {lowest} or more")


@dataclass(frozen=True, slots=True)
class CropBox:
    """Rows top to bottom, columns left to right, both exclusive at their end."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Index of the box's pixels."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


class CropSegmenter:
    """Shows another segmenter the box around the region and puts its answer back in place.

    A region that is the whole frame, or whose box grows to it, goes to the other segmenter untouched. Tokens, prefill,
    stages and confidence are the other one's, of the crop; an empty region is answered without asking it.

    Args:
        inner: who segments.
        options: the box.
    """

    def __init__(self, inner: Segmenter, options: CropOptions) -> None:
        self._inner = inner
        self._options = options
        self.name = f"crop:{inner.name}"
        self.revision = inner.revision
        self.device = inner.device
        self.uses_detections = bool(getattr(inner, "uses_detections", True))

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """See `Segmenter`.

        Raises:
            ModelError: the other segmenter's mask or uncertainty is not of the crop's size.
        """
        if not roi.any():
            return Segmentation(np.zeros_like(roi), 1.0)
        box = crop_box(roi, self._options)
        height, width = roi.shape
        if box == CropBox(0, height, 0, width):
            return self._inner.segment(image, roi, prompt, context)
        window = box.window
        shown = np.ascontiguousarray(image[window])
        inside = replace(context, detections=detections_inside(context.detections, box))
        answer = self._inner.segment(shown, np.ascontiguousarray(roi[window]), prompt, inside)
        return replace(
            answer,
            mask=self._put_back(answer.mask, box, roi.shape),
            uncertainty=None if answer.uncertainty is None else self._put_back(answer.uncertainty, box, roi.shape),
        )

    def forget_stream(self, stream: str) -> None:
        """Passed on where the other segmenter keeps anything."""
        forget = getattr(self._inner, "forget_stream", None)
        if forget is not None:
            forget(stream)

    def _put_back(self, part: Any, box: CropBox, shape: tuple[int, ...]) -> Any:
        expected = box.bottom - box.top, box.right - box.left
        if part.shape != expected:
            raise ModelError(
                f"segmenter {self._inner.name} answered a crop of {expected[1]}x{expected[0]} pixels with "
                f"{part.dtype} {list(part.shape)}"
            )
        whole = np.zeros(shape, part.dtype)
        whole[box.window] = part
        return whole


def crop_box(roi: BoolMask, options: CropOptions) -> CropBox:
    """The box to show: the region's, grown by the margin, to the shortest side and the aspect, and out to the grid.

    Args:
        roi: bool [height, width] with at least one pixel.
        options: how it grows; it never leaves the frame, which limits all of them.
    """
    height, width = roi.shape
    rows, columns = (np.flatnonzero(roi.any(axis=axis)) for axis in (1, 0))
    top, bottom = max(int(rows[0]) - options.margin, 0), min(int(rows[-1]) + 1 + options.margin, height)
    left, right = max(int(columns[0]) - options.margin, 0), min(int(columns[-1]) + 1 + options.margin, width)
    shortest_height = max(options.min_side, math.ceil((right - left) / options.max_aspect))
    shortest_width = max(options.min_side, math.ceil((bottom - top) / options.max_aspect))
    return CropBox(
        *on_grid(*widened(top, bottom, shortest_height, height), options.align, height),
        *on_grid(*widened(left, right, shortest_width, width), options.align, width),
    )


def widened(start: int, end: int, shortest: int, limit: int) -> tuple[int, int]:
    """An interval widened about its middle to at least ``shortest``, moved and cut to lie inside 0..limit."""
    length = max(end - start, min(shortest, limit))
    start -= (length - (end - start)) // 2
    start = min(max(start, 0), limit - length)
    return start, start + length


def on_grid(start: int, end: int, step: int, limit: int) -> tuple[int, int]:
    """An interval grown to multiples of ``step``, inside 0..limit."""
    return start // step * step, min(-(-end // step) * step, limit)


def detections_inside(detections: Detections, box: CropBox) -> Detections:
    """The detections that reach into a box, in its pixels; what hangs over stays."""
    x_min, y_min, x_max, y_max = detections.boxes_xyxy.T
    inside = detections.select((x_min < box.right) & (x_max > box.left) & (y_min < box.bottom) & (y_max > box.top))
    corner = np.array([box.left, box.top, box.left, box.top], np.float32)
    return replace(inside, boxes_xyxy=inside.boxes_xyxy - corner)


def load_crop(argument: str, options: BackendOptions) -> CropSegmenter:
    """Entry point ``crop:SEGMENTER`` or ``crop?margin=32&max_aspect=2:SEGMENTER``."""
    query, segmenter = "", argument
    if argument.startswith("?"):
        query, _, segmenter = argument.removeprefix("?").partition(":")
    (settings,) = read_options(f"crop?{query}", query, CropOptions)
    if not segmenter:
        raise ConfigurationError("crop needs the segmenter that it shows its crops to: --segmenter crop:lisa:FOLDER")
    return CropSegmenter(load_segmenter(segmenter, options), CropOptions(**settings))
