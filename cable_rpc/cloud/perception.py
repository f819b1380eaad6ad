"""The models' part of a frame: its boxes, and a mask inside its region."""

from __future__ import annotations

import asyncio
import contextvars
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from cable_rpc.cloud.backends import BatchSegmenter, Detector, FrameContext, SegmentationRequest, Segmenter
from cable_rpc.cloud.batching import BatchingRunner, BatchPolicy
from cable_rpc.cloud.model_batches import DetectionRequest, detect_batch, segment_batch
from cable_rpc.cloud.model_runner import ModelRun, ModelRunner
from cable_rpc.cloud.telemetry import Telemetry
from cable_rpc.types import BoolMask, Detections, Image, Segmentation

log = logging.getLogger(__name__)

A = TypeVar("A")
B = TypeVar("B")
P = TypeVar("P")
Q = TypeVar("Q")

DEFAULT_PROMPT = "Please segment all vehicles, pedestrians and cyclists on the road."


@dataclass(frozen=True, slots=True)
class StageRun:
    """One model's share of a frame's time."""

    stage: str
    wait_ns: int
    run_ns: int
    batch_size: int
    start_time_ns: int = 0

    @classmethod
    def of(cls, stage: str, run: ModelRun[Any]) -> StageRun:
        """Names a model run."""
        return cls(stage, run.wait_ns, run.run_ns, run.batch_size, run.start_time_ns)

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


@dataclass(frozen=True, slots=True)
class PerceptionRequest:
    """One picture for both models."""

    image: Image
    """uint8 [H, W, 3] BGR, outside the region what the treatment shows there."""
    roi: BoolMask | None
    """bool [H, W]; None = the whole frame."""
    min_score: float
    """Detections below are dropped."""
    prompt: str = ""
    """Sentence for the segmenter; empty = `DEFAULT_PROMPT`."""
    sequence: int = 0
    """The camera's frame number."""


TakeRequest = Callable[[], PerceptionRequest | None]


class PerceptionModels:
    """The detector and the segmenter that all sessions of a server share.

    Args:
        detector: what the clients are told of it; it runs in ``detector_runner``.
        segmenter: likewise.
        detector_runner: where detection runs.
        segmenter_runner: where segmentation runs.
        side_by_side: a segmenter that needs no detections runs beside the detector; False = after it all the same,
            where each model's time is to be measured alone.
    """

    def __init__(
        self,
        detector: Detector,
        segmenter: Segmenter,
        detector_runner: ModelRunner[DetectionRequest, Detections],
        segmenter_runner: ModelRunner[SegmentationRequest, Segmentation],
        *,
        side_by_side: bool = True,
    ) -> None:
        self.detector = detector
        self.segmenter = segmenter
        self._detector_runner = detector_runner
        self._segmenter_runner = segmenter_runner
        self._side_by_side = side_by_side and not getattr(segmenter, "uses_detections", True)
        self._farewells: set[asyncio.Task[None]] = set()

    @classmethod
    def in_process(
        cls,
        detector: Detector,
        segmenter: Segmenter,
        detector_batches: BatchPolicy | None = None,
        segmenter_batches: BatchPolicy | None = None,
        *,
        side_by_side: bool = True,
    ) -> PerceptionModels:
        """Both models in threads of this process, in batches as the policies say; one frame at a time by default.

        A segmenter that takes one frame at a time gets no batches: its first frame would only wait for the last.
        """
        if not isinstance(segmenter, BatchSegmenter):
            segmenter_batches = None
        return cls(
            detector,
            segmenter,
            BatchingRunner("detector", partial(detect_batch, detector), detector_batches),
            BatchingRunner("segmenter", partial(segment_batch, segmenter), segmenter_batches),
            side_by_side=side_by_side,
        )

    def tell_batches(self, telemetry: Telemetry) -> None:
        """From now on, batches that run in this process are told of."""
        for model, runner in (("detect", self._detector_runner), ("segment", self._segmenter_runner)):
            if isinstance(runner, BatchingRunner):
                runner.batch_done = partial(telemetry.batch_done, model)

    def close(self) -> None:
        """Ends the models' threads after what they are doing."""
        self._detector_runner.close()
        self._segmenter_runner.close()

    async def perceive(self, request: PerceptionRequest, stream: str = "") -> Perception:
        """Runs both models on one picture.

        Args:
            request: the picture.
            stream: the camera's session.
        """
        perception = await self.perceive_newest(lambda: request, stream)
        assert perception is not None  # noqa: S101 - there was a request to take
        return perception

    async def perceive_newest(self, take: TakeRequest, stream: str = "") -> Perception | None:
        """Runs both models on the picture that ``take`` gives when the first of them has a place for it.

        Returns None where it gave none.
        """
        if self._side_by_side:
            return await self._detect_beside_segment(take, stream)
        return await self._detect_then_segment(take, stream)

    async def _detect_then_segment(self, take: TakeRequest, stream: str) -> Perception | None:
        taken: list[PerceptionRequest] = []
        detected = await self._detector_runner.infer(_noting(take, taken, _detection_request))
        if detected is None:
            return None
        (request,) = taken
        detections, doubtful = _by_score(detected.value, request.min_score)
        context = FrameContext(request.sequence, detections, stream, doubtful)
        segmented = await self._segmenter_runner.infer(lambda: _segmentation_request(request, context))
        return None if segmented is None else _perception(detections, detected, segmented)

    async def _detect_beside_segment(self, take: TakeRequest, stream: str) -> Perception | None:
        """The busier model chooses the frame, and the other one joins in.

        Were it the other way round, the frame would grow old in the busier one's queue.
        """
        taken: list[PerceptionRequest] = []

        def segmentation_request(request: PerceptionRequest) -> SegmentationRequest:
            return _segmentation_request(request, FrameContext(request.sequence, Detections.empty(), stream))

        detected: ModelRun[Detections] | None
        segmented: ModelRun[Segmentation] | None
        if self._detector_runner.backlog_s() >= self._segmenter_runner.backlog_s():
            detected, segmented = await _together(
                self._detector_runner,
                _noting(take, taken, _detection_request),
                self._segmenter_runner,
                lambda: segmentation_request(taken[0]),
            )
        else:
            segmented, detected = await _together(
                self._segmenter_runner,
                _noting(take, taken, segmentation_request),
                self._detector_runner,
                lambda: _detection_request(taken[0]),
            )
        if detected is None or segmented is None:
            return None
        return _perception(_by_score(detected.value, taken[0].min_score)[0], detected, segmented)

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
            await self._segmenter_runner.call(lambda: forget(stream))
        except Exception:
            log.exception("segmenter %s did not forget session %s", self.segmenter.name, stream)


async def _together(
    leader: ModelRunner[A, P], lead: Callable[[], A | None], follower: ModelRunner[B, Q], follow: Callable[[], B | None]
) -> tuple[ModelRun[P] | None, ModelRun[Q] | None]:
    """Queues for the leader; its frame goes to the follower as soon as the leader has taken it."""
    context = contextvars.copy_context()
    following: list[asyncio.Task[ModelRun[Q] | None]] = []

    def take() -> A | None:
        item = lead()
        if item is not None:
            # Called in whichever session's task completes the batch; what follows belongs to this one's.
            following.append(asyncio.create_task(follower.infer(follow), context=context))
        return item

    try:
        led = await leader.infer(take)
        return (led, await following[0]) if led is not None and following else (None, None)
    finally:
        for task in following:
            task.cancel()
        await asyncio.gather(*following, return_exceptions=True)


def _noting(
    take: TakeRequest, taken: list[PerceptionRequest], convert: Callable[[PerceptionRequest], A]
) -> Callable[[], A | None]:
    """Gives what ``take`` gives as a model wants it, and puts it down in ``taken``."""

    def give() -> A | None:
        request = take()
        if request is None:
            return None
        taken.append(request)
        return convert(request)

    return give


def _detection_request(request: PerceptionRequest) -> DetectionRequest:
    return DetectionRequest(request.image, request.roi)


def _by_score(found: Detections, min_score: float) -> tuple[Detections, Detections]:
    """What is asked for, and what is too doubtful."""
    asked_for = found.scores >= min_score
    if asked_for.all():
        return found, Detections.empty()
    return found.select(asked_for), found.select(~asked_for)


def _segmentation_request(request: PerceptionRequest, context: FrameContext) -> SegmentationRequest:
    roi = request.roi
    if roi is None:
        roi = np.ones(request.image.shape[:2], np.bool_)
    return SegmentationRequest(request.image, roi, request.prompt or DEFAULT_PROMPT, context)


def _perception(
    detections: Detections, detected: ModelRun[Detections], segmented: ModelRun[Segmentation]
) -> Perception:
    stages = (
        StageRun.of("detect", detected),
        StageRun.of("segment", segmented),
        *StageRun.parts("segment", segmented),
    )
    return Perception(detections, segmented.value, stages)
