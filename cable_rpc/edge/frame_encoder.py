"""From a camera frame to the message that is sent: region, background fill, codec. Runs off the event loop."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from cable_codecs import (
    JPEG_CURVE,
    STILL_CODECS,
    WEBP_CURVE,
    CodecParameters,
    EncodedFrame,
    RegionTreatment,
    StillRateController,
    StillRateStatus,
    TreatedEncoder,
    TreatedPacket,
)

from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.strategy import RoiStrategy
from cable_rpc.tracing.context import SpanContext
from cable_rpc.types import RoiMask
from cable_rpc.wire.convert import ego_to_message, region_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb


@dataclass(frozen=True, slots=True)
class PreparedFrame:
    """A frame ready to be sent, and what it took to make it so."""

    captured: CapturedFrame
    proposal: RoiProposal
    encoded: EncodedFrame
    message: pb.VideoFrame
    sent_region: RoiMask
    """What was sent: the proposal's region as treated, or the whole frame."""
    roi_ns: int
    fill_ns: int
    started_time_ns: int
    """When its preparation began, monotonic clock."""
    encoded_time_ns: int
    """When it was coded, monotonic clock."""

    @property
    def index(self) -> int:
        """The camera's frame number."""
        return self.captured.frame.index

    @property
    def uplink_message_bytes(self) -> int:
        """Size of the whole serialised request."""
        return pb.StreamPerceptionRequest(frame=self.message).ByteSize()


class FrameEncoder:
    """One stream's region strategy, treatment, encoder and rate control. Not thread-safe; one worker calls it.

    Args:
        strategy: chooses the region.
        parameters: of the codec; with ``bitrate_kbps`` image codecs are kept at that rate by their quality.
        treatment: what becomes of regions; None takes what measured best for the codec.
        trace_every: one of so many frames is marked to be traced, the first among them; 0 = none.

    Raises:
        CodecError: the codec can't be opened, or can't carry pictures treated so.
    """

    def __init__(
        self,
        strategy: RoiStrategy,
        parameters: CodecParameters,
        treatment: RegionTreatment | None = None,
        trace_every: int = 0,
    ) -> None:
        self._trace_every = trace_every
        self._prepared = 0
        self.strategy = strategy
        self._is_still = parameters.name in STILL_CODECS
        self.treatment = RegionTreatment.default_for(stateless=self._is_still) if treatment is None else treatment
        self._rate: StillRateController | None = None
        if self._is_still and parameters.bitrate_kbps is not None:
            self._rate = StillRateController(
                parameters.bitrate_kbps,
                parameters.frame_rate,
                frame_pixels=parameters.width * parameters.height,
                curve=WEBP_CURVE if parameters.name == "webp" else JPEG_CURVE,
            )
            parameters = replace(parameters, bitrate_kbps=None)
        self._encoder = TreatedEncoder(parameters, self.treatment)
        self.last_index: int | None = None
        """The frame coded last."""

    @property
    def fallback_reason(self) -> str | None:
        """Why it isn't the encoder that was asked for; None where it is."""
        return self._encoder.encoder.fallback_reason

    @property
    def rate_status(self) -> StillRateStatus | None:
        """How the rate of an image codec is kept; None without a target."""
        return None if self._rate is None else self._rate.status

    def prepare(self, captured: CapturedFrame, *, force_keyframe: bool) -> PreparedFrame:
        """Chooses the region, treats it, encodes.

        Args:
            captured: the frame.
            force_keyframe: True makes the packet decodable without earlier ones.

        Raises:
            CodecError: if the frame does not fit the encoder.
        """
        frame = captured.frame
        started_ns = time.monotonic_ns()
        proposal = self.strategy.propose(frame)
        roi_ns = time.monotonic_ns() - started_ns
        region = proposal.roi
        whole = proposal.keyframe or bool(region.blocks.all())
        if self._rate is not None:
            pixels = round(region.coverage * region.height * region.width)
            self._encoder.set_quality(self._rate.quality_for(pixels, whole=whole))
        packet = self._encoder.encode(
            frame.image, None if whole else region.blocks, region.block_size, keyframe=force_keyframe
        )
        encoded_ns = time.monotonic_ns()
        if self._rate is not None:
            self._rate.coded(len(packet.encoded.data))
        message = self._message(captured, proposal, packet, roi_ns)
        if packet.blocks is None:
            sent = RoiMask.full(*frame.size_hw, region.block_size)
        else:
            sent = RoiMask(packet.blocks, packet.block_size, *frame.size_hw)
            message.region.CopyFrom(region_to_message(sent))
        self.last_index = frame.index
        return PreparedFrame(
            captured, proposal, packet.encoded, message, sent, roi_ns, packet.treat_ns, started_ns, encoded_ns
        )

    def close(self) -> None:
        """Frees the codec."""
        self._encoder.close()

    def _traceparent(self) -> str:
        """What begins a trace of the next frame; empty where it is not its turn."""
        is_due = self._trace_every > 0 and self._prepared % self._trace_every == 0
        self._prepared += 1
        return SpanContext.new_trace().to_traceparent() if is_due else ""

    def _message(
        self, captured: CapturedFrame, proposal: RoiProposal, packet: TreatedPacket, roi_ns: int
    ) -> pb.VideoFrame:
        frame, encoded = captured.frame, packet.encoded
        message = pb.VideoFrame(
            sequence=frame.index,
            capture_time_ns=captured.available_time_ns,
            data=encoded.data,
            keyframe=encoded.keyframe,
            whole_frame=proposal.keyframe,
            traceparent=self._traceparent(),
            timing=pb.EdgeTiming(
                capture_ns=captured.capture_ns,
                roi_ns=roi_ns,
                fill_ns=packet.treat_ns,
                encode_ns=encoded.duration_ns,
            ),
        )
        if proposal.prior_index is not None:
            message.prior_sequence = proposal.prior_index
        if frame.ego is not None:
            message.ego_motion.CopyFrom(ego_to_message(frame.ego))
        if not (self._is_still or encoded.keyframe) and self.last_index is not None:
            message.reference_sequence = self.last_index
        return message
