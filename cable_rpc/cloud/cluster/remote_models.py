"""Models in Ray Serve deployments of their own, asked by the replicas that hold the sessions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Generic, TypeVar

from cable_rpc.cloud.backends import SegmentationRequest
from cable_rpc.cloud.batching import BatchingRunner, BatchPolicy
from cable_rpc.cloud.model_batches import DetectionRequest, detect_batch, segment_batch
from cable_rpc.cloud.model_runner import ModelRun
from cable_rpc.cloud.model_settings import ModelSettings
from cable_rpc.types import Detections, Segmentation

Item = TypeVar("Item")
Answer = TypeVar("Answer")
T = TypeVar("T")

FORGET_AFTER_S = 600.0
"""A replica is not told when a session ends, since no call reaches all replicas."""


@dataclass(frozen=True, slots=True)
class ModelFace:
    """What a session knows of a model elsewhere."""

    name: str
    revision: str
    device: str
    uses_detections: bool = True


class BatchingModel(Generic[Item, Answer]):
    """A model behind the scheduler of an in-process server."""

    def __init__(self, face: ModelFace, run: Callable[[Sequence[Item]], list[Answer]], policy: BatchPolicy) -> None:
        self._face = face
        self._runner = BatchingRunner(face.name, run, policy)

    async def face(self) -> dict[str, Any]:
        """Name, revision and device."""
        return asdict(self._face)

    async def infer(self, item: Item) -> ModelRun[Answer]:
        """One frame, in a batch with those of other replicas' sessions."""
        run = await self._runner.infer(lambda: item)
        assert run is not None  # noqa: S101 - there was an item to take
        return run


class DetectorDeployment(BatchingModel[DetectionRequest, Detections]):
    """The detector."""

    def __init__(self, settings: ModelSettings) -> None:
        model = settings.load_detector()
        face = ModelFace(model.name, model.revision, model.device)
        super().__init__(face, lambda requests: detect_batch(model, requests), settings.detector_policy(model.device))


class SegmenterDeployment(BatchingModel[SegmentationRequest, Segmentation]):
    """The segmenter."""

    def __init__(self, settings: ModelSettings) -> None:
        model = settings.load_segmenter()
        face = ModelFace(model.name, model.revision, model.device, bool(getattr(model, "uses_detections", True)))
        forget = getattr(model, "forget_stream", None)
        last_seen_s: dict[str, float] = {}

        def run(requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
            now_s = time.monotonic()
            for stream in [one for one, seen_s in last_seen_s.items() if now_s - seen_s > FORGET_AFTER_S]:
                del last_seen_s[stream]
                if forget is not None:
                    forget(stream)
            last_seen_s.update((request.context.stream, now_s) for request in requests)
            return segment_batch(model, requests)

        super().__init__(face, run, settings.segmenter_policy(model.device))


class RemoteRunner(Generic[Item, Answer]):
    """A `ModelRunner` whose model is a deployment.

    Frames travel by value: through Ray's object store a picture of a megabyte takes longer.
    """

    def __init__(self, handle: Any) -> None:
        self._handle = handle.options(_by_reference=False)

    async def infer(self, take: Callable[[], Item | None]) -> ModelRun[Answer] | None:
        """See `ModelRunner`; the frame is taken when it is sent."""
        item = take()
        if item is None:
            return None
        asked_ns = time.monotonic_ns()
        run: ModelRun[Answer] = await self._handle.infer.remote(item)
        took_ns = time.monotonic_ns() - asked_ns
        # The replica's clock is another machine's: where the run stood in our time is not told.
        return ModelRun(run.value, took_ns - run.run_ns, run.run_ns, run.batch_size)

    def backlog_s(self) -> float:
        """See `ModelRunner`; not known here."""
        return 0.0

    async def call(self, function: Callable[[], T]) -> T:
        """See `ModelRunner`; runs here, since functions don't travel."""
        return function()

    def close(self) -> None:
        """See `ModelRunner`; the deployment outlives its callers."""
