"""Several real streams over one server's models: batches, side-by-side models, shedding."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from cable_codecs import EncodedFrame

from cable_rpc.cloud.backends import FrameContext, SegmentationRequest
from cable_rpc.cloud.batching import BatchPolicy
from cable_rpc.cloud.perception import PerceptionModels, PerceptionRequest
from cable_rpc.cloud.service import PerceptionServer, ServerConfig
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.types import BoolMask, Detections, Image, Segmentation
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector
from .test_protocol import coded, frame, opened, read


class GatedDetector(BrightBoxDetector):
    """Finds bright boxes once it is let through; keeps the sizes of its batches."""

    def __init__(self) -> None:
        self.batches: list[int] = []
        self.begun = threading.Semaphore(0)
        self.gate = threading.Semaphore(0)

    def detect(self, images: Sequence[Image]) -> list[Detections]:
        self.batches.append(len(images))
        self.begun.release()
        assert self.gate.acquire(timeout=20)
        return super().detect(images)

    async def has_begun(self) -> None:
        assert await asyncio.to_thread(self.begun.acquire, timeout=20)


class LookingSegmenter:
    """Needs no boxes; its mask is what is bright. Tells whether it was asked while the detector was busy."""

    name, revision, device = "looking", "test", "cpu"
    uses_detections = False

    def __init__(self) -> None:
        self.contexts: list[FrameContext] = []
        self.batches: list[int] = []
        self.asked = threading.Event()

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        return self.segment_batch([SegmentationRequest(image, roi, prompt, context)])[0]

    def segment_batch(self, requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
        self.contexts += [request.context for request in requests]
        self.batches.append(len(requests))
        self.asked.set()
        return [Segmentation(request.image.max(axis=2) > 200, 1.0) for request in requests]


def serving(models: PerceptionModels, **limits: Any) -> PerceptionServer:
    return PerceptionServer(
        models, ServerConfig("127.0.0.1:0", SessionLimits(close_timeout_s=1.0, **limits), drain_s=1.0)
    )


def packets(count: int) -> list[EncodedFrame]:
    return coded("jpeg", count)


async def test_streams_run_in_one_batch_and_get_their_own_answers(stub_for: Any) -> None:
    detector = GatedDetector()
    models = PerceptionModels.in_process(detector, LookingSegmenter(), BatchPolicy(max_batch=8))
    async with serving(models) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        calls = [await opened(stub) for _ in range(5)]
        for number, call in enumerate(calls):
            await call.write(frame(100 * number, packets(1)[0]))
            if number == 0:
                await detector.has_begun()
        await asyncio.sleep(0.2)
        detector.gate.release(10)
        answers = [await read(call) for call in calls]
        assert [answer.result.sequence for answer in answers] == [0, 100, 200, 300, 400]
        assert detector.batches == [1, 4]
        sizes = [answer.result.timing.stages[0].batch_size for answer in answers]
        assert sizes == [1, 4, 4, 4, 4]
        waited = [answer.result.timing.stages[0].wait_ns for answer in answers]
        assert min(waited[1:]) > 100_000_000 > waited[0]
        for call in calls:
            call.cancel()
    models.close()


async def test_a_segmenter_without_need_of_boxes_runs_beside_the_detector(stub_for: Any) -> None:
    detector, segmenter = GatedDetector(), LookingSegmenter()
    models = PerceptionModels.in_process(detector, segmenter)
    async with serving(models) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        call = await opened(stub)
        await call.write(frame(3, packets(1)[0]))
        await detector.has_begun()
        assert await asyncio.to_thread(segmenter.asked.wait, 10)
        detector.gate.release()
        answer = (await read(call)).result
        assert len(answer.detections) == 1
        assert segmenter.contexts[0].sequence == 3
        assert len(segmenter.contexts[0].detections) == 0
        detect, segment = answer.timing.stages
        assert detect.start_time_ns < segment.start_time_ns + segment.run_ns
        assert segment.start_time_ns < detect.start_time_ns + detect.run_ns
        call.cancel()
    models.close()


async def test_the_frame_in_both_models_is_the_same_one_and_the_newest(stub_for: Any) -> None:
    detector, segmenter = GatedDetector(), LookingSegmenter()
    models = PerceptionModels.in_process(detector, segmenter)
    async with serving(models, max_in_flight=4) as server, stub_for(f"127.0.0.1:{server.port}") as stub:
        busy, call = await opened(stub), await opened(stub)
        await busy.write(frame(0, packets(1)[0]))
        await detector.has_begun()
        # The segmenter is free: it settles the frame of both at once, so the later ones wait for the next turn.
        for sequence, packet in enumerate(packets(3)):
            await call.write(frame(sequence, packet))
            await asyncio.sleep(0.1)
        detector.gate.release(10)
        kinds = [(await read(call)).WhichOneof("payload") for _ in range(3)]
        assert kinds == ["result", "frame_rejected", "result"]
        assert [context.sequence for context in segmenter.contexts] == [0, 0, 2]
        call.cancel()
        busy.cancel()
    models.close()


async def test_overload_sheds_frames_with_a_status_and_every_frame_is_answered_once(stub_for: Any) -> None:
    """Twelve streams on a model for two: none is stuck, what is answered began in time."""

    class SlowDetector(BrightBoxDetector):
        def detect(self, images: Sequence[Image]) -> list[Detections]:
            threading.Event().wait(0.03 * len(images))
            return super().detect(images)

    bound_s = 0.15
    models = PerceptionModels.in_process(SlowDetector(), LookingSegmenter(), BatchPolicy(max_batch=2))
    packet = packets(1)[0]
    async with serving(models, latency_bound_s=bound_s) as server, stub_for(f"127.0.0.1:{server.port}") as stub:

        async def stream() -> tuple[list[pb.StreamPerceptionResponse], int]:
            call = await opened(stub)
            answers = []
            for sequence in range(8):
                await call.write(frame(sequence, packet))
                answers.append(await read(call))
            call.cancel()
            return answers, len(answers)

        outcomes = await asyncio.wait_for(asyncio.gather(*(stream() for _ in range(12))), 60)
    models.close()
    shed = 0
    for answers, _ in outcomes:
        told = [getattr(answer, answer.WhichOneof("payload")) for answer in answers]
        assert [one.sequence for one in told] == list(range(8))
        for one in told:
            if isinstance(one, pb.FrameRejected):
                assert one.reason == pb.REJECT_REASON_OVERLOADED
                assert "bound is 150 ms" in one.message
                shed += 1
            else:
                begun_ns = min(stage.start_time_ns for stage in one.timing.stages)
                assert begun_ns - one.timing.receive_time_ns < (bound_s + 0.05) * 1e9
    assert shed > 0
    assert shed < 12 * 8


async def test_measuring_runs_put_one_model_after_the_other() -> None:
    segmenter = LookingSegmenter()
    models = PerceptionModels.in_process(BrightBoxDetector(), segmenter, side_by_side=False)
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[5:10, 5:15] = 255
    perception = await models.perceive(PerceptionRequest(picture, None, 0.4, sequence=9), "camera")
    assert len(segmenter.contexts[0].detections) == 1
    assert segmenter.contexts[0].stream == "camera"
    detect, segment = perception.stages
    assert segment.start_time_ns >= detect.start_time_ns + detect.run_ns
    assert perception.segmentation.mask.sum() == 50
    models.close()


async def test_a_stream_whose_frames_overtake_each_other_is_advised_to_send_one_at_a_time(stub_for: Any) -> None:
    class SlowDetector(BrightBoxDetector):
        def detect(self, images: Sequence[Image]) -> list[Detections]:
            threading.Event().wait(0.02)
            return super().detect(images)

    models = PerceptionModels.in_process(SlowDetector(), LookingSegmenter())
    packet = packets(1)[0]
    async with serving(models) as server, stub_for(f"127.0.0.1:{server.port}") as stub:

        async def flood() -> int:
            """As many frames as the grant allows until the advice comes; returns it."""
            call = await opened(stub)
            for sequence in range(2):
                await call.write(frame(sequence, packet))
            for sequence in range(2, 200):
                answer = await read(call)
                if answer.WhichOneof("payload") == "flow_update":
                    call.cancel()
                    return answer.flow_update.max_in_flight
                await call.write(frame(sequence, packet))
            raise AssertionError("no advice")

        assert await asyncio.gather(*(flood() for _ in range(4))) == [1] * 4
    models.close()
