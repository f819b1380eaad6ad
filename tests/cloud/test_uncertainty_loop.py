"""What the segmenter doubts and what a frame cost, from end to end over a real socket, as a strategy hears it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from cable_codecs import CodecParameters

from cable_rpc.cloud.backends import FrameContext
from cable_rpc.cloud.segmenters import BoxSegmenter
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.edge.capture import Capture
from cable_rpc.edge.client import PerceptionClient, SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.streamer import EdgeStreamer, StreamedFrame
from cable_rpc.errors import RemoteError
from cable_rpc.types import BoolMask, Detections, Frame, Image, RoiMask, Segmentation
from cable_rpc.wire.v1 import perception_pb2 as pb

from .conftest import BrightBoxDetector

WIDTH, HEIGHT, FPS = 157, 93, 20.0
REGION_COLUMNS = 10
"""Blocks of 8 pixels that the strategy double keeps, from the left."""


class StillLife:
    """The same textured picture over and over."""

    name = "still life"
    fps = FPS
    size_wh = (WIDTH, HEIGHT)

    def __init__(self, count: int) -> None:
        self.frame_count: int | None = count

    def __iter__(self) -> Iterator[Frame]:
        image = np.random.default_rng(1).integers(60, 120, (HEIGHT, WIDTH, 3), np.uint8)
        for index in range(self.frame_count or 0):
            yield Frame(image, index, round(index * 1e9 / FPS))


class Listener:
    """Sends frame 0 whole, then the left part; writes down everything it is told."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int]] = []
        self.threads: set[int] = set()
        self.byte_counts: dict[int, int] = {}
        self.masks: dict[int, BoolMask] = {}
        self.confidences: dict[int, float] = {}
        self.uncertainties: dict[int, Any] = {}

    def note(self, call: str, index: int) -> None:
        self.calls.append((call, index))
        self.threads.add(threading.get_ident())

    def propose(self, frame: Frame) -> RoiProposal:
        self.note("propose", frame.index)
        roi = RoiMask.full(*frame.size_hw)
        if frame.index:
            roi.blocks[:, REGION_COLUMNS:] = False
        return RoiProposal(roi, keyframe=frame.index == 0, coverage=roi.coverage)

    def update(self, index: int, mask: BoolMask, *, confidence: float = 1.0, uncertainty: Any = None) -> None:
        self.note("update", index)
        self.masks[index], self.confidences[index], self.uncertainties[index] = mask, confidence, uncertainty

    def sent(self, index: int, byte_count: int) -> None:
        self.note("sent", index)
        self.byte_counts[index] = byte_count

    def request_keyframe(self) -> None:
        self.note("request_keyframe", -1)


class TwoBoxes(BrightBoxDetector):
    """Overlapping boxes on both sides of the region's edge at x = 80; the better one lies inside the other."""

    def one(self, image: Image) -> Detections:
        boxes = np.array([[45.5, 20, 100, 60], [30, 10, 120, 80]], np.float32)
        return Detections(boxes, np.array([2, 2], np.int32), np.array([0.75, 0.5], np.float32))


class SilentSegmenter(BoxSegmenter):
    """Tells no uncertainty."""

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        return Segmentation(roi.copy(), 0.25)


class MisshapenSegmenter(BoxSegmenter):
    """Tells the uncertainty of another picture on odd frames."""

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        wrong = np.zeros((3, 3), np.uint8) if context.sequence % 2 else None
        return Segmentation(roi.copy(), 1.0, uncertainty=wrong)


class DawdlingClient(PerceptionClient):
    """Comes back from sending long after the answer is there."""

    async def send(self, frame: pb.VideoFrame) -> None:
        await super().send(frame)
        await asyncio.sleep(0.05)


async def streamed(
    target: str, strategy: Listener, count: int = 3, client_class: type[PerceptionClient] = PerceptionClient
) -> list[StreamedFrame]:
    request = SessionRequest("jpeg", WIDTH, HEIGHT, FPS)
    async with client_class(target, request) as client:
        encoder = FrameEncoder(strategy, CodecParameters("jpeg", WIDTH, HEIGHT, FPS))
        return [frame async for frame in EdgeStreamer(Capture(StillLife(count), realtime=False), encoder, client).run()]


def stated(region: bool) -> np.ndarray:
    """Pixel by pixel: 255 (1 - best score), in the region; block by block: the largest, up to 0, 85, 170 or 255."""
    pixels = np.zeros((HEIGHT, WIDTH))
    for y in range(HEIGHT):
        for x in range(WIDTH if not region else 8 * REGION_COLUMNS):
            if 20 <= y < 60 and 45 <= x < 100:
                pixels[y, x] = round(255 * 0.25)
            elif 10 <= y < 80 and 30 <= x < 120:
                pixels[y, x] = round(255 * 0.5)
    blocks = np.zeros((HEIGHT, WIDTH), np.uint8)
    for y in range(0, HEIGHT, 8):
        for x in range(0, WIDTH, 8):
            block = np.s_[y : y + 8, x : x + 8]
            blocks[block] = 85 * np.ceil(pixels[block].max() / 85)
    return blocks


async def test_the_strategy_hears_what_the_segmenter_doubts(running_server: Any) -> None:
    listener = Listener()
    async with running_server(detector=TwoBoxes()) as target:
        frames = await streamed(target, listener)
    assert [frame.answer.rejection for frame in frames] == [None] * 3
    assert listener.confidences == {0: 0.625, 1: 0.625, 2: 0.625}
    for index, uncertainty in listener.uncertainties.items():
        assert np.array_equal(uncertainty, stated(region=index > 0))
    assert listener.uncertainties[0][:, 80:].any(), "the boxes must reach beyond the region for the cut to show"
    assert {85, 170} <= set(np.unique(listener.uncertainties[1]))
    assert all(frame.answer.uncertainty_data for frame in frames)


async def test_silence_is_told_as_silence(running_server: Any) -> None:
    listener = Listener()
    async with running_server(segmenter=SilentSegmenter()) as target:
        frames = await streamed(target, listener)
    assert listener.uncertainties == {0: None, 1: None, 2: None}
    assert listener.confidences == {0: 0.25, 1: 0.25, 2: 0.25}
    assert [frame.answer.uncertainty_data for frame in frames] == [b""] * 3
    assert not listener.masks[1][:, 80:].any()
    assert listener.masks[1][:, :80].all()


async def test_a_misshapen_map_costs_its_frame_and_no_more(running_server: Any) -> None:
    listener = Listener()
    async with running_server(segmenter=MisshapenSegmenter()) as target:
        frames = await streamed(target, listener)
    assert [frame.answer.rejection is None for frame in frames] == [True, False, True]
    said = frames[1].answer.rejection
    assert said is not None
    assert said.startswith("MODEL_FAILED")
    assert "uint8 [93, 157], got uint8 [3, 3]" in said
    assert sorted(listener.masks) == [0, 2]


@pytest.mark.parametrize("client_class", [PerceptionClient, DawdlingClient])
async def test_the_strategy_learns_a_frame_s_cost_before_its_answer(
    running_server: Any, client_class: type[PerceptionClient]
) -> None:
    listener = Listener()
    async with running_server() as target:
        frames = await streamed(target, listener, 5, client_class)
    for index in range(5):
        places = [listener.calls.index((call, index)) for call in ("propose", "sent", "update")]
        assert places == sorted(places)
    assert len(listener.calls) == 15
    assert len(listener.threads) == 1
    for frame in frames:
        on_the_wire = pb.StreamPerceptionRequest(frame=frame.prepared.message).SerializeToString()
        assert listener.byte_counts[frame.prepared.index] == len(on_the_wire)


async def test_a_frame_that_could_not_be_sent_has_no_cost(running_server: Any) -> None:
    listener = Listener()
    async with running_server(limits=SessionLimits(max_frame_bytes=100, close_timeout_s=0.1)) as target:
        with pytest.raises(RemoteError, match="accepts 100"):
            await streamed(target, listener)
    assert listener.calls == [("propose", 0)]
