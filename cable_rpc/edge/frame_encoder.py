"""From a camera frame to the message that is sent: region, background fill, codec. Runs off the event loop."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from cable_codecs import CodecParameters, EncodedFrame, create_encoder, fill_blocks

from cable_rpc.edge.capture import CapturedFrame
from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.edge.strategy import RoiStrategy
from cable_rpc.types import Image
from cable_rpc.wire.convert import ego_to_message, region_to_message
from cable_rpc.wire.v1 import perception_pb2 as pb

STILL_CODECS = frozenset({"jpeg", "webp"})


@dataclass(frozen=True, slots=True)
class PreparedFrame:
    """A frame ready to be sent, and what it took to make it so."""

    captured: CapturedFrame
    proposal: RoiProposal
    encoded: EncodedFrame
    message: pb.VideoFrame
    roi_ns: int
    fill_ns: int

    @property
    def index(self) -> int:
        """The camera's frame number."""
        return self.captured.frame.index

    @property
    def uplink_message_bytes(self) -> int:
        """Size of the whole serialised request."""
        return pb.StreamPerceptionRequest(frame=self.message).ByteSize()


class FrameEncoder:
    """One stream's region strategy, fill buffer and encoder. Not thread-safe; one worker calls it."""

    def __init__(self, strategy: RoiStrategy, parameters: CodecParameters) -> None:
        self.strategy = strategy
        self._encoder = create_encoder(parameters)
        self._is_still = parameters.name in STILL_CODECS
        self._canvas: Image = np.empty((parameters.height, parameters.width, 3), np.uint8)
        self._last_index: int | None = None

    def prepare(self, captured: CapturedFrame, *, force_keyframe: bool) -> PreparedFrame:
        """Chooses the region, blanks the rest, encodes.

        Args:
            captured: the frame.
            force_keyframe: True makes the packet decodable without earlier ones.

        Raises:
            CodecError: if the frame does not fit the encoder.
        """
        frame = captured.frame
        started_ns = time.monotonic_ns()
        proposal = self.strategy.propose(frame)
        proposed_ns = time.monotonic_ns()
        region = proposal.roi
        whole = proposal.keyframe or bool(region.blocks.all())
        image = (
            frame.image
            if whole
            else fill_blocks(frame.image, region.blocks, region.block_size, "zero", out=self._canvas)
        )
        filled_ns = time.monotonic_ns()
        roi = None if whole else region.pixels()
        encoded = self._encoder.encode(image, roi, keyframe=force_keyframe)
        message = pb.VideoFrame(
            sequence=frame.index,
            capture_time_ns=captured.available_time_ns,
            data=encoded.data,
            keyframe=encoded.keyframe,
            whole_frame=proposal.keyframe,
            timing=pb.EdgeTiming(
                capture_ns=captured.capture_ns,
                roi_ns=proposed_ns - started_ns,
                fill_ns=filled_ns - proposed_ns,
                encode_ns=encoded.duration_ns,
            ),
        )
        if not whole:
            message.region.CopyFrom(region_to_message(proposal.roi))
        if proposal.prior_index is not None:
            message.prior_sequence = proposal.prior_index
        if frame.ego is not None:
            message.ego_motion.CopyFrom(ego_to_message(frame.ego))
        if not (self._is_still or encoded.keyframe) and self._last_index is not None:
            message.reference_sequence = self._last_index
        self._last_index = frame.index
        return PreparedFrame(captured, proposal, encoded, message, proposed_ns - started_ns, filled_ns - proposed_ns)

    def close(self) -> None:
        """Frees the codec."""
        self._encoder.close()
