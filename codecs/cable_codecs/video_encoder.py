"""Live video of any codec: one packet out for each frame in, keyframes on demand."""

from __future__ import annotations

import time

import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType

from cable_codecs.base import BoolMask, CodecParameters, EncodedFrame, Encoder, Image, check_frame, check_rate
from cable_codecs.colour import BgrToI420
from cable_codecs.encoder_choice import choose_encoder, frame_for, open_video
from cable_codecs.errors import CodecError
from cable_codecs.ffmpeg import encode_single
from cable_codecs.quantiser_offset import OffsetAttacher
from cable_codecs.video_format import VideoFormat, highest_kbps, opening_rate

LEAST_BUFFER_FRAMES = 3
"""x264 falls short of the rate where its buffer holds fewer frames."""


class VideoEncoder(Encoder):
    """Encodes without delay, B-frames or look-ahead, at constant quality or constant bit rate.

    A keyframe carries its headers in band. It comes first, then at most ``keyframe_interval`` frames apart, and
    where asked for; scene cuts insert none, since when to pay for one is the caller's decision.
    """

    def __init__(self, parameters: CodecParameters, video: VideoFormat) -> None:
        super().__init__(parameters)
        self.video = video
        self.quality = parameters.quality_within(*video.quality_range, video.default_quality)
        self.bitrate_kbps = parameters.bitrate_kbps
        self.spec, self.fallback_reason = choose_encoder(parameters, video)
        try:
            self.context: VideoCodecContext | None = self.open_context()
        except CodecError as error:
            if not self.spec.hardware:
                raise
            self.spec = video.software
            self.fallback_reason = f"{self.spec.library} is used instead: {error}"
            self.context = self.open_context()
        self.implementation = self.spec.library
        coded = video.coded_size(parameters)
        self.to_picture = BgrToI420(parameters.height, parameters.width, full_range=False, coded=coded)
        self.attacher: OffsetAttacher | None = None
        if parameters.background_offset > 0:
            self.attacher = OffsetAttacher(
                *coded,
                parameters.background_offset,
                pixel_format=self.spec.pixel_format,
                size_offset=parameters.size_offset,
            )
            self.everything: BoolMask = np.ones(coded, np.bool_)
        self.frame_count = 0

    def open_context(self) -> VideoCodecContext:
        """Open the encoder at the quality or rate in force.

        Raises:
            CodecError: It can't be opened.
        """
        context = open_video(self.spec, self.video, self.parameters, self.quality, self.bitrate_kbps)
        self.opened_at = (self.quality, self.bitrate_kbps)
        self.buffer_bits = opening_rate(self.parameters, self.bitrate_kbps).buffer
        return context

    def set_bitrate(self, kbps: float) -> None:
        """Change the bit rate from the next frame on.

        libx264 follows without a keyframe as long as its buffer, sized at opening, holds three frames of the new
        rate; all others are opened anew.
        """
        if self.bitrate_kbps is None:
            raise CodecError(f"{self.parameters.name} encoder holds its quality; open it with bitrate_kbps")
        check_rate("bit rate", kbps)
        ceiling = highest_kbps(self.parameters, kbps)
        if kbps > ceiling:
            raise CodecError(
                f"{kbps:g} kbit/s is above the ceiling of {ceiling:g} kbit/s; "
                "open the encoder with a higher ceiling_kbps"
            )
        self.bitrate_kbps = kbps
        buffer_frames = self.buffer_bits * self.parameters.frame_rate / (kbps * 1000)
        if self.context is not None and self.spec.live_bitrate and buffer_frames >= LEAST_BUFFER_FRAMES:
            self.context.bit_rate = round(kbps * 1000)
            self.opened_at = (self.quality, kbps)

    def set_quality(self, quality: int) -> None:
        """Change the CRF from the next frame on, which opens the encoder anew."""
        if self.bitrate_kbps is not None:
            raise CodecError(f"{self.parameters.name} encoder holds its bit rate; open it without bitrate_kbps")
        low, high = self.video.quality_range
        if not low <= quality <= high:
            raise CodecError(f"{self.parameters.name} quality must be {low}..{high}, got {quality}")
        self.quality = quality

    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode the next frame; ``roi`` changes nothing without ``background_offset``, None is all of the frame."""
        started = time.monotonic_ns()
        name = self.parameters.name
        if self.context is None:
            raise CodecError(f"{name} encoder is closed; open a new one")
        check_frame(image, roi, self.parameters)
        if self.opened_at != (self.quality, self.bitrate_kbps):
            self.context = self.open_context()
            self.reopen_count += 1
        frame = frame_for(self.spec, self.to_picture(image), self.video.coded_size(self.parameters))
        frame.pts = self.frame_count
        if self.attacher is not None:
            # libx265 crashes where offsets come with later frames and not with the first.
            frame = self.attacher.attach(frame, self.everything if roi is None else roi)
            frame.pts = self.frame_count
        # Explicit also where none is asked for: frames that come from a decoder carry its picture types.
        frame.pict_type = PictureType.I if keyframe else PictureType.NONE
        self.frame_count += 1
        data = encode_single(self.context, frame, name)
        return EncodedFrame(data, self.video.summarise(data).keyframe, time.monotonic_ns() - started)

    def close(self) -> None:
        """Release the codec."""
        self.context = None
