"""What a detector and a segmenter must offer, and how back ends are found by name.

A back end registers through an entry point of the group ``cable_rpc.detectors`` or ``cable_rpc.segmenters``: a
callable ``(argument: str, options: BackendOptions) -> Detector | Segmenter``. ``--segmenter lisa:FOLDER`` calls the
entry point ``lisa`` with ``"FOLDER"``; a back end that wraps another one has its options before the colon, and
``--segmenter crop?margin=32:lisa:FOLDER`` calls ``crop`` with ``"?margin=32:lisa:FOLDER"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Protocol, cast, runtime_checkable

from cable_rpc.errors import ConfigurationError
from cable_rpc.types import BoolMask, Detections, Image, Segmentation


@dataclass(frozen=True, slots=True)
class BackendOptions:
    """Settings that every back end is given."""

    device: str = "auto"
    """"auto", "cpu" or "cuda"."""
    threads: int = 1
    """CPU threads of one model."""
    min_score: float = 0.4
    """Detections below are dropped (the paper's threshold)."""


@dataclass(frozen=True, slots=True)
class FrameContext:
    """What is known of a frame besides its pixels."""

    sequence: int
    """The camera's frame number."""
    detections: Detections
    """The detector's boxes of the same picture."""
    stream: str = ""
    """Which camera's session it belongs to, for what a back end keeps from frame to frame; "" = none in particular."""
    doubtful: Detections | None = None
    """Those that the session doesn't ask for because their score is too low, as far as the detector tells them."""


class Detector(Protocol):
    """Finds road users."""

    name: str
    revision: str
    device: str

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        """Boxes for each uint8 [H, W, 3] BGR image, best score first, in pixels of that image."""
        ...


@runtime_checkable
class RegionDetector(Protocol):
    """A detector that makes use of where objects can be. A caller with regions asks it in place of ``detect``."""

    def detect_regions(self, images: Sequence[Image], regions: Sequence[BoolMask | None]) -> list[Detections]:
        """Boxes for each uint8 [H, W, 3] BGR image, in pixels of all of it; regions bool [H, W], None = everywhere."""
        ...


@dataclass(frozen=True, slots=True)
class SegmentationRequest:
    """What `Segmenter.segment` is asked, as data."""

    image: Image
    """uint8 [H, W, 3] BGR."""
    roi: BoolMask
    """bool [H, W]."""
    prompt: str
    context: FrameContext


class Segmenter(Protocol):
    """Answers with a mask of road actors.

    One that makes no use of ``FrameContext.detections`` may say so with ``uses_detections = False``: it then runs
    beside the detector and not after it, and gets no detections.

    One that keeps anything by ``FrameContext.stream`` may also have ``forget_stream(stream: str) -> None``: it is
    called when a session has ended, where ``segment`` runs and after its last frame, also for unknown streams.
    """

    name: str
    revision: str
    device: str

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """Mask for a uint8 [H, W, 3] BGR image whose pixels outside ``roi`` (bool [H, W]) are made up
        (the region's own colours, one colour, an old background).

        The caller intersects the mask with the region.
        """
        ...


@runtime_checkable
class BatchSegmenter(Protocol):
    """A segmenter that answers several frames, of any sizes, prompts and streams, sooner than one after the other."""

    def segment_batch(self, requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
        """One answer for each request, as `Segmenter.segment` gives it."""
        ...


def _load(kind: str, spec: str, options: BackendOptions) -> Any:
    head, colon, argument = spec.partition(":")
    name, mark, query = head.partition("?")
    if mark:
        argument = f"?{query}{colon}{argument}"
    known = {entry.name: entry for entry in entry_points(group=f"cable_rpc.{kind}s")}
    if name not in known:
        raise ConfigurationError(
            f"no {kind} back end is called '{name}' (from '{spec}'); installed: {', '.join(sorted(known))}"
        )
    return known[name].load()(argument, options)


def load_detector(spec: str, options: BackendOptions) -> Detector:
    """Loads ``NAME`` or ``NAME:ARGUMENT``, e.g. ``onnx:model.onnx``.

    Raises:
        ConfigurationError: unknown name (lists the installed ones) or unusable argument.
        ModelError: the model can't be loaded.
    """
    return cast(Detector, _load("detector", spec, options))


def load_segmenter(spec: str, options: BackendOptions) -> Segmenter:
    """Like `load_detector`, for segmenters, e.g. ``boxes``."""
    return cast(Segmenter, _load("segmenter", spec, options))
