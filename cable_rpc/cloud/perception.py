"""The models' part of a frame: boxes, then a mask inside the region."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cable_rpc.cloud.backends import Detector, FrameContext, RegionDetector, Segmenter
from cable_rpc.cloud.model_runner import ModelRun, ModelRunner
from cable_rpc.errors import ModelError
from cable_rpc.types import BoolMask, Detections, Image, Segmentation

log = logging.getLogger(__name__)

DEFAULT_PROMPT = "Please segment all vehicles, pedestrians and cyclists on the road."


@dataclass(frozen=True, slots=True)
class StageRun:
    """One model's share of a frame's time."""

    stage: str
    wait_ns: int
    run_ns: int
    batch_size: int

    @classmethod
    def of(cls, stage: str, run: ModelRun[Any]) -> StageRun:
        """Names a model run."""
        return cls(stage, run.wait_ns, run.run_ns, run.batch_size)

    @classmethod
    def parts(cls, stage: str, run: ModelRun[Segmentation]) -> tuple[StageRun, ...]:
        """The parts of its time that a segmenter tells, named ``STAGE.PART``."""
        stages = run.value.stages_ns
        return tuple(cls(f"{stage}.{part}", 0, took_ns, run.batch_size) for part, took_ns in stages.items())


@dataclass(frozen=True, slots=True)
class Perception:
    """What the models say of one frame."""

    detections: Detections
    segmentation: Segmentation
    stages: tuple[StageRun, ...]


class PerceptionModels:
    """The detector and the segmenter that all sessions of a server share."""

    def __init__(
        self,
        detector: Detector,
        segmenter: Segmenter,
        detector_runner: ModelRunner,
        segmenter_runner: ModelRunner,
    ) -> None:
        self.detector = detector
        self.segmenter = segmenter
        self._detector_runner = detector_runner
        self._segmenter_runner = segmenter_runner
        self._farewells: set[asyncio.Task[None]] = set()

    async def perceive(
        self, image: Image, roi: BoolMask | None, *, prompt: str, min_score: float, sequence: int, stream: str = ""
    ) -> Perception:
        """Runs both models on one picture.

        Args:
            image: uint8 [H, W, 3] BGR, outside the region what the treatment shows there.
            roi: bool [H, W]; None = the whole frame.
            prompt: sentence for the segmenter; empty = `DEFAULT_PROMPT`.
            min_score: detections below are dropped.
            sequence: the camera's frame number.
            stream: the camera's session.
        """
        detected = await self._detector_runner.infer(lambda: _detect(self.detector, image, roi))
        asked_for = detected.value.scores >= min_score
        detections = detected.value.select(asked_for)
        context = FrameContext(sequence, detections, stream, detected.value.select(~asked_for))
        segmented = await self._segmenter_runner.infer(
            lambda: _inside(self.segmenter, image, roi, prompt or DEFAULT_PROMPT, context)
        )
        stages = (
            StageRun.of("detect", detected),
            StageRun.of("segment", segmented),
            *StageRun.parts("segment", segmented),
        )
        return Perception(detections, segmented.value, stages)

    def forget_stream(self, stream: str) -> None:
        """Lets the segmenter drop what it keeps of an ended session, once it has answered that session's frames.

        Returns at once: a session must not end late because the model is busy with another one's frame.
        """
        forget = getattr(self.segmenter, "forget_stream", None)
        if forget is not None:
            farewell = asyncio.create_task(self._forget(forget, stream))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)

    async def _forget(self, forget: Callable[[str], None], stream: str) -> None:
        try:
            await self._segmenter_runner.infer(lambda: forget(stream))
        except Exception:
            log.exception("segmenter %s did not forget session %s", self.segmenter.name, stream)


def _detect(detector: Detector, image: Image, roi: BoolMask | None) -> Detections:
    """Boxes of a picture; a detector that can look at a region closely is told which."""
    if roi is not None and isinstance(detector, RegionDetector):
        return detector.detect_regions([image], [roi])[0]
    return detector.detect([image])[0]


def _inside(
    segmenter: Segmenter, image: Image, roi: BoolMask | None, prompt: str, context: FrameContext
) -> Segmentation:
    """M_k = F(I~_k, p) intersected with R_k; outside it nothing is known, so there is no uncertainty either.

    Raises:
        ModelError: if the segmenter's uncertainty is not uint8 of the picture's size.
    """
    whole = np.ones(image.shape[:2], np.bool_) if roi is None else roi
    segmentation = segmenter.segment(image, whole, prompt, context)
    uncertainty = segmentation.uncertainty
    if uncertainty is not None and (uncertainty.shape != image.shape[:2] or uncertainty.dtype != np.uint8):
        raise ModelError(
            f"segmenter {segmenter.name} must state its uncertainty as uint8 {list(image.shape[:2])}, got "
            f"{uncertainty.dtype} {list(uncertainty.shape)}"
        )
    if roi is None:
        return segmentation
    known = None if uncertainty is None else np.where(roi, uncertainty, np.uint8(0))
    return replace(segmentation, mask=segmentation.mask & roi, uncertainty=known)
