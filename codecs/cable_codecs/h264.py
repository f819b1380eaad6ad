"""H.264 without delay: libx264 in, FFmpeg's h264 decoder out, Annex B packets between them."""

from __future__ import annotations

import time

from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType

from cable_codecs.annexb import parse_access_unit
from cable_codecs.base import BoolMask, CodecParameters, Decoder, EncodedFrame, Encoder, Image, check_frame
from cable_codecs.colour import BgrToI420, I420ToBgr, even
from cable_codecs.errors import CodecError
from cable_codecs.ffmpeg import (
    decode_single,
    encode_single,
    frame_of_picture,
    open_decoder,
    open_encoder,
    read_picture,
)

DEFAULT_CRF = 28


def padded_size(parameters: CodecParameters) -> tuple[int, int]:
    """(height, width) of the coded picture: 4:2:0 H.264 has only even sizes."""
    return even(parameters.height), even(parameters.width)


class H264Encoder(Encoder):
    """x264 veryfast with zero latency at constant rate factor.

    A keyframe is an IDR picture with its parameter sets in band. It comes first, then at most
    ``keyframe_interval`` frames apart, and where asked for; scene cuts insert none, since when to pay for one
    is the caller's decision.
    """

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters)
        crf = parameters.quality_within(0, 51, DEFAULT_CRF)
        options = {
            "preset": "veryfast",
            "tune": "zerolatency",
            # High profile has no lossless mode, which CRF 0 is.
            "profile": "high" if crf > 0 else "high444",
            "crf": str(crf),
            "forced-idr": "1",
            "sc_threshold": "0",
        }
        self.context: VideoCodecContext | None = open_encoder(
            "libx264",
            parameters,
            size=padded_size(parameters),
            full_range=False,
            options=options,
            interval=parameters.keyframe_interval,
        )
        self.to_picture = BgrToI420(parameters.height, parameters.width, full_range=False)
        self.frame_count = 0

    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode the next frame; ``roi`` changes nothing."""
        started = time.monotonic_ns()
        if self.context is None:
            raise CodecError("h264 encoder is closed; open a new one")
        check_frame(image, roi, self.parameters)
        frame = frame_of_picture(self.to_picture(image), *padded_size(self.parameters), "yuv420p")
        frame.pts = self.frame_count
        frame.pict_type = PictureType.I if keyframe else PictureType.NONE
        self.frame_count += 1
        data = encode_single(self.context, frame, "h264")
        return EncodedFrame(data, parse_access_unit(data).is_idr, time.monotonic_ns() - started)

    def close(self) -> None:
        """Release the codec."""
        self.context = None


class H264Decoder(Decoder):
    """Starts at an IDR picture, and after any error waits for the next one rather than show drifted frames.

    A packet that never arrives can't be noticed here: the decoder goes on with a stale reference and without
    an error. Number the packets in the transport and ask for a keyframe where one is missing.
    """

    def __init__(self, parameters: CodecParameters) -> None:
        super().__init__(parameters)
        self.context: VideoCodecContext | None = open_decoder("h264", parameters)
        self.to_image = I420ToBgr(parameters.height, parameters.width, full_range=False)
        self.synchronised = False

    @property
    def needs_keyframe(self) -> bool:
        """True at the start and after an error, until an IDR picture decodes cleanly."""
        return not self.synchronised

    def decode(self, data: bytes) -> Image:
        """Decode one access unit."""
        if self.context is None:
            raise CodecError("h264 decoder is closed; open a new one")
        was_synchronised, self.synchronised = self.synchronised, False
        try:
            check_access_unit(data, was_synchronised)
            frame = decode_single(self.context, data, self.parameters)
            read_picture(frame, self.to_image.picture, padded_size(self.parameters), ("yuv420p",), "h264")
        except CodecError:
            # A fresh context forgets damaged references and parameter sets; opening takes about 1 ms.
            self.context = open_decoder("h264", self.parameters)
            raise
        self.synchronised = True
        return self.to_image()

    def close(self) -> None:
        """Release the codec."""
        self.context = None


def check_access_unit(data: bytes, synchronised: bool) -> None:
    """Check that a packet is one access unit that can be decoded in the decoder's state.

    Raises:
        CodecError: No picture or several in the packet, or an IDR picture with its parameter sets is needed.
    """
    unit = parse_access_unit(data)
    if unit.picture_count != 1:
        raise CodecError(
            f"h264 packet of {len(data)} bytes holds {unit.picture_count} pictures, expected exactly one; "
            "send one whole Annex B access unit per packet"
        )
    if unit.is_idr and not unit.has_parameter_sets:
        raise CodecError("h264 keyframe comes without parameter sets; put SPS and PPS in band before each IDR")
    if not synchronised and not unit.is_idr:
        raise CodecError("h264 decoder needs a keyframe first, got a predicted picture; request a keyframe")
