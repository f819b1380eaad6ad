"""From a VideoFrame message to the picture that the models see: checks, decoding, treatment undone. Off the loop."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from cable_codecs import STILL_CODECS, CodecError, CodecParameters, RegionTreatment, TreatedDecoder

from cable_rpc.cloud.bounds import check_codec_config
from cable_rpc.errors import FrameError, ProtocolError
from cable_rpc.types import BoolMask, Image, RoiMask
from cable_rpc.wire.convert import codec_name, region_from_message
from cable_rpc.wire.treatment import treatment_from_message
from cable_rpc.wire.v1 import perception_pb2 as pb

NOTHING_BUT_BLACK = RegionTreatment(grid=1)
"""What a client does that says nothing of its treatment."""


class FrameRejection(FrameError):
    """This frame can't be processed; carries the machine-readable reason."""

    def __init__(self, reason: pb.RejectReason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """A decoded picture, outside its region as the treatment has it: refilled, composed or kept."""

    image: Image
    """uint8 [H, W, 3] BGR."""
    roi: BoolMask | None
    """bool [H, W]; None = the whole frame."""


class StreamDecoder:
    """Decoder state of one session.

    Raises:
        ProtocolError: if the configuration is unusable (unknown codec, size zero or above the limit).
    """

    def __init__(self, config: pb.CodecConfig, max_pixels: int) -> None:
        name = codec_name(config.codec)
        check_codec_config(config, max_pixels)
        self._height, self._width = config.height, config.width
        self._is_video = name not in STILL_CODECS
        treatment = treatment_from_message(config.treatment) if config.HasField("treatment") else NOTHING_BUT_BLACK
        try:
            parameters = CodecParameters(name, config.width, config.height, config.frame_rate or 10.0)
            self._decoder = TreatedDecoder(parameters, treatment)
        except CodecError as error:
            raise ProtocolError(str(error)) from error
        self._in_use = threading.Lock()
        self._lost = False
        self.last_good_sequence: int | None = None

    @property
    def needs_keyframe(self) -> bool:
        """True when the next frame must be a keyframe."""
        return self._is_video and (self._lost or self._decoder.needs_keyframe)

    def mark_lost(self) -> None:
        """A coded frame never reached the decoder; later frames that refer to it are refused."""
        self._lost = True

    def decode(self, frame: pb.VideoFrame) -> DecodedFrame:
        """Decodes one frame and undoes its treatment.

        Raises:
            FrameRejection: with the reason that the client is told.
        """
        region = self._region(frame)
        self._check_reference(frame)
        try:
            with self._in_use:
                restored = self._decoder.decode(
                    frame.data,
                    None if region is None else region.blocks,
                    1 if region is None else region.block_size,
                    stamp=frame.sequence,
                )
        except CodecError as error:
            self.mark_lost()
            raise FrameRejection(
                pb.REJECT_REASON_UNDECODABLE, f"frame {frame.sequence} can't be decoded: {error}"
            ) from error
        self._lost = False
        self.last_good_sequence = frame.sequence
        return DecodedFrame(restored.image, restored.roi)

    def wait_idle(self) -> None:
        """Returns when no decode is running in another thread."""
        with self._in_use:
            pass

    def close(self) -> None:
        """Frees the codec, after a decode that is still running in another thread."""
        with self._in_use:
            self._decoder.close()

    def _region(self, frame: pb.VideoFrame) -> RoiMask | None:
        if not frame.HasField("region"):
            return None
        try:
            return region_from_message(frame.region, self._height, self._width)
        except ProtocolError as error:
            self.mark_lost()
            raise FrameRejection(pb.REJECT_REASON_INVALID_REGION, f"frame {frame.sequence}: {error}") from error

    def _check_reference(self, frame: pb.VideoFrame) -> None:
        if not self._is_video or frame.keyframe:
            return
        if self.needs_keyframe:
            raise FrameRejection(
                pb.REJECT_REASON_UNDECODABLE,
                f"frame {frame.sequence} is not a keyframe, and the decoder needs one; force an IDR",
            )
        if not frame.HasField("reference_sequence") or frame.reference_sequence != self.last_good_sequence:
            shown = frame.reference_sequence if frame.HasField("reference_sequence") else "nothing"
            self.mark_lost()
            raise FrameRejection(
                pb.REJECT_REASON_UNDECODABLE,
                f"frame {frame.sequence} refers to {shown}, but the last frame decoded here is "
                f"{self.last_good_sequence}; force an IDR",
            )
