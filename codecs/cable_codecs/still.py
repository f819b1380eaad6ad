"""JPEG and lossy WebP by FFmpeg: every frame on its own."""

from __future__ import annotations

import bisect
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from av.video.codeccontext import VideoCodecContext

from cable_codecs.base import BoolMask, CodecParameters, Decoder, EncodedFrame, Encoder, Image, check_frame
from cable_codecs.colour import BgrToI420, I420ToBgr
from cable_codecs.errors import CodecError
from cable_codecs.ffmpeg import (
    decode_single,
    encode_single,
    frame_of_picture,
    open_decoder,
    open_encoder,
    read_picture,
)
from cable_codecs.still_container import check_jpeg, check_webp

DEFAULT_QUALITY = 75
WEBP_METHOD = 2
"""libwebp's effort 0..6. Its own default, 4, saves 5-10 % of the bytes and gains 0.2-0.6 dB but takes 2.2 to 3.2
times as long, thirty times as long as JPEG; method 0 takes half the time of 2 and gains 1 dB for 40-65 % more bytes."""

LIBJPEG_QUALITY_OF_SCALE = (
    94.4, 89.1, 82.4, 75.3, 68.6, 61.4, 54.7, 46.6, 41.9, 38.1, 34.0, 30.6, 28.5, 26.0, 24.3, 22.6,
    21.4, 20.3, 19.3, 18.4, 17.8, 17.1, 16.3, 15.7, 15.1, 14.6, 14.0, 13.6, 13.2, 12.7, 12.3,
)  # fmt: skip
"""For the quantiser scales 1..31 of FFmpeg's mjpeg the libjpeg quality that gives as many bytes.

Median over six road images (four stills, one KITTI frame, one 720p video frame); single images lie up to 10
off in mid range.
"""


def jpeg_quantiser_scale(quality: int) -> int:
    """The mjpeg quantiser scale 1..31 whose bytes come closest to libjpeg's at a quality 1..100.

    mjpeg has only 31 steps, so neighbouring qualities share one; 92..100 give scale 1 and 1..12 scale 31.
    """
    descending = [-value for value in LIBJPEG_QUALITY_OF_SCALE]
    after = bisect.bisect_left(descending, -quality)
    candidates = [index for index in (after - 1, after) if 0 <= index < len(descending)]
    return 1 + min(candidates, key=lambda index: abs(descending[index] + quality))


@dataclass(frozen=True, slots=True)
class StillFormat:
    """What sets one still-image codec apart from another."""

    encoder: str
    decoder: str
    full_range: bool
    pixel_formats: tuple[str, ...]
    """Pixel formats accepted from the decoder."""
    options: Callable[[CodecParameters, int], Mapping[str, str]]
    """Encoder options from parameters and quality."""
    check: Callable[[bytes, tuple[int, int], str], object]
    """Refuses a file that isn't whole, given its bytes, (height, width) and the codec's name."""


def jpeg_options(parameters: CodecParameters, quality: int) -> dict[str, str]:
    """Encoder options; FFmpeg would silently ignore ``qscale`` with ``global_quality`` here."""
    if parameters.preset is not None:
        raise CodecError(f"{parameters.name} has no presets, got {parameters.preset!r}; leave it out")
    scale = str(jpeg_quantiser_scale(quality))
    return {"qmin": scale, "qmax": scale, "huffman": "optimal"}


def webp_options(parameters: CodecParameters, quality: int) -> dict[str, str]:
    """Encoder options."""
    method = str(webp_method(parameters, WEBP_METHOD))
    return {"quality": str(quality), "compression_level": method, "lossless": "0"}


def webp_method(parameters: CodecParameters, default: int) -> int:
    """libwebp's effort from the preset.

    Raises:
        CodecError: The preset isn't a number 0..6.
    """
    if parameters.preset is None:
        return default
    if parameters.preset not in tuple("0123456"):
        raise CodecError(f"{parameters.name} preset must be a number 0..6, got {parameters.preset!r}")
    return int(parameters.preset)


JPEG = StillFormat(
    "mjpeg", "mjpeg", full_range=True, pixel_formats=("yuvj420p",), options=jpeg_options, check=check_jpeg
)
WEBP = StillFormat(
    "libwebp",
    "webp",
    full_range=False,
    pixel_formats=("yuv420p",),
    options=webp_options,
    check=lambda data, size, name: check_webp(data, name),
)


class StillEncoder(Encoder):
    """Encodes each frame as a complete image file; every packet is a keyframe."""

    def __init__(self, parameters: CodecParameters, still: StillFormat) -> None:
        super().__init__(parameters)
        self.still = still
        self.implementation = still.encoder
        self.quality = parameters.quality_within(1, 100, DEFAULT_QUALITY)
        self.context: VideoCodecContext | None = self.open_context()
        self.to_picture = BgrToI420(parameters.height, parameters.width, full_range=still.full_range)
        self.pixel_format = "yuvj420p" if still.full_range else "yuv420p"
        self.frame_count = 0

    def open_context(self) -> VideoCodecContext:
        """Open the encoder at the quality in force, which takes about 0.1 ms.

        Raises:
            CodecError: It can't be opened.
        """
        return open_encoder(
            self.still.encoder,
            self.parameters,
            size=(self.parameters.height, self.parameters.width),
            full_range=self.still.full_range,
            options=self.still.options(self.parameters, self.quality),
        )

    def set_quality(self, quality: int) -> None:
        """Change the quality 1..100 from the next frame on."""
        if not 1 <= quality <= 100:
            raise CodecError(f"{self.parameters.name} quality must be 1..100, got {quality}")
        if quality != self.quality and self.context is not None:
            self.quality = quality
            self.context = self.open_context()

    def encode(self, image: Image, roi: BoolMask | None = None, *, keyframe: bool = False) -> EncodedFrame:
        """Encode one image; ``roi`` and ``keyframe`` change nothing."""
        started = time.monotonic_ns()
        if self.context is None:
            raise CodecError(f"{self.parameters.name} encoder is closed; open a new one")
        check_frame(image, roi, self.parameters)
        height, width = image.shape[:2]
        frame = frame_of_picture(self.to_picture(image), height, width, self.pixel_format)
        frame.pts = self.frame_count
        self.frame_count += 1
        data = encode_single(self.context, frame, self.parameters.name)
        return EncodedFrame(data, keyframe=True, duration_ns=time.monotonic_ns() - started)

    def close(self) -> None:
        """Release the codec."""
        self.context = None


class StillDecoder(Decoder):
    """Decodes complete image files."""

    def __init__(self, parameters: CodecParameters, still: StillFormat) -> None:
        super().__init__(parameters)
        self.implementation = still.decoder
        self.still = still
        self.context: VideoCodecContext | None = open_decoder(still.decoder, parameters)
        size = (parameters.height, parameters.width)
        self.to_image = I420ToBgr(*size, full_range=still.full_range)

    @property
    def needs_keyframe(self) -> bool:
        """False: every image stands alone."""
        return False

    def decode(self, data: bytes) -> Image:
        """Decode one image file."""
        if self.context is None:
            raise CodecError(f"{self.parameters.name} decoder is closed; open a new one")
        size = (self.parameters.height, self.parameters.width)
        try:
            self.still.check(data, size, self.parameters.name)
            frame = decode_single(self.context, data, self.parameters)
            read_picture(frame, self.to_image.picture, size, self.still.pixel_formats, self.parameters.name)
        except CodecError:
            self.context = open_decoder(self.still.decoder, self.parameters)
            raise
        return self.to_image()

    def close(self) -> None:
        """Release the codec."""
        self.context = None
