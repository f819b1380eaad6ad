"""One strategy's way through the loop, frame by frame: propose, encode, decode, perceive, apply."""

from __future__ import annotations

import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace

from cable_codecs import CodecParameters, RegionTreatment

from cable_rpc.data.source import FrameSource
from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.client import SessionRequest
from cable_rpc.edge.frame_encoder import FrameEncoder, PreparedFrame
from cable_rpc.edge.strategy import RoiStrategy
from cable_rpc.errors import RemoteError
from cable_rpc.study.closed_loop.models import LoadedModels
from cable_rpc.study.closed_loop.session_in_process import NOMINAL_DURATION_NS, SessionInProcess
from cable_rpc.types import Detections, Image, Segmentation
from cable_rpc.wire.answers import FrameAnswer
from cable_rpc.wire.v1 import perception_pb2 as pb


@dataclass(frozen=True, slots=True)
class LaneSettings:
    """How a lane's frames are coded, and what the models are asked."""

    codec: str
    quality: int | None
    treatment: RegionTreatment
    prompt: str
    min_score: float
    bitrate_kbps: int | None = None
    """Target of the codec's rate control, in place of a quality."""
    nominal_times: bool = False
    """Messages carry nominal durations and the source's own stamps, so that equal settings give equal bytes: numbers
    take more bytes the larger they are."""


@dataclass(frozen=True, slots=True)
class Passage:
    """A frame that went the whole way."""

    prepared: PreparedFrame
    answer: FrameAnswer
    segmentation: Segmentation
    detections: Detections
    """Weak ones included."""
    picture: Image
    """uint8 [height, width, 3], BGR, as the models saw it."""
    apply_ns: int

    @property
    def stages_ns(self) -> dict[str, int]:
        """Every stage that was measured, in the order of the way; waiting and the link are none."""
        times = self.answer.times
        return {
            "roi": self.prepared.roi_ns,
            "fill": self.prepared.fill_ns,
            "encode": self.prepared.encoded.duration_ns,
            "decode": times.decode_ns,
            "detect": times.run_ns.get("detect", 0),
            "segment": times.run_ns.get("segment", 0),
            "apply": self.apply_ns,
        }


class Lane:
    """A strategy, its encoder and its session; use as an async context manager.

    Raises:
        CodecError: the codec can't be opened, or can't carry pictures treated so.
    """

    def __init__(
        self, strategy: RoiStrategy, settings: LaneSettings, source: FrameSource, models: LoadedModels
    ) -> None:
        width, height = source.size_wh
        self._keeper = models.keeper
        self._stack = AsyncExitStack()
        parameters = CodecParameters(
            settings.codec, width, height, source.fps, settings.quality, bitrate_kbps=settings.bitrate_kbps
        )
        self._encoder = FrameEncoder(strategy, parameters, settings.treatment)
        self._nominal_times = settings.nominal_times
        self._stack.callback(self._encoder.close)
        request = SessionRequest(
            codec=settings.codec,
            width=width,
            height=height,
            frame_rate=source.fps,
            quality=settings.quality or 0,
            prompt=settings.prompt,
            min_score=settings.min_score,
            treatment=settings.treatment,
        )
        self._session = SessionInProcess(models.perception, request, nominal_times=settings.nominal_times)

    async def __aenter__(self) -> Lane:
        async with self._stack:
            await self._stack.enter_async_context(self._session)
            self._stack = self._stack.pop_all()
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    async def carry(self, captured: CapturedFrame) -> Passage:
        """Takes one frame through the loop and applies the answer, before which no other frame is proposed.

        Raises:
            CodecError: encoding failed.
            FrameError: the session could not process the frame.
            RemoteError: the session closed, or answered without a mask.
        """
        passage = await self.send(captured)
        return replace(passage, apply_ns=self.apply(passage))

    async def send(self, captured: CapturedFrame) -> Passage:
        """Takes one frame to the cloud and back, and leaves the answer to `apply`.

        Raises:
            CodecError: encoding failed.
            FrameError: the session could not process the frame.
            RemoteError: the session closed, or answered without a mask.
        """
        prepared = self._encoder.prepare(captured, force_keyframe=False)
        # As the client stamps it; the stamp is part of the message's size.
        prepared.message.send_time_ns = time.monotonic_ns()
        if self._nominal_times:
            set_nominal_times(prepared.message, captured.frame.capture_time_ns)
        self._encoder.strategy.sent(prepared.index, prepared.uplink_message_bytes)
        answer = await self._session.exchange(prepared.message)
        picture = self._keeper.picture
        if answer.segmentation is None or picture is None:
            raise RemoteError(f"frame {prepared.index} was answered without a mask")
        return Passage(prepared, answer, answer.segmentation, self._keeper.newest, picture, 0)

    def apply(self, passage: Passage) -> int:
        """Tells the strategy what the cloud answered, each frame once, in order.

        Returns:
            What it took, in ns.
        """
        started_ns = time.monotonic_ns()
        self._encoder.strategy.update(
            passage.answer.sequence,
            passage.segmentation.mask,
            confidence=passage.segmentation.confidence,
            uncertainty=passage.segmentation.uncertainty,
        )
        return time.monotonic_ns() - started_ns


def set_nominal_times(message: pb.VideoFrame, capture_time_ns: int) -> None:
    """Stamps of the source's clock, and durations as long as they usually are."""
    message.capture_time_ns = message.send_time_ns = capture_time_ns
    timing = message.timing
    timing.capture_ns = timing.roi_ns = timing.fill_ns = timing.encode_ns = NOMINAL_DURATION_NS
