"""JPEG and WebP: every frame on its own."""

from __future__ import annotations

import bisect
import time
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

DEFAULT_QUALITY = 75
WEBP_METHOD = 4
"""libwebp's effort 0..6; 4 is its default and takes about 24 times as long as JPEG, 0 a third of that."""

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


JPEG = StillFormat("mjpeg", "mjpeg", full_range=True, pixel_formats=("yuvj420p",))
WEBP = StillFormat("libwebp", "webp", full_range=False, pixel_formats=("yuv420p",))


def jpeg_options(parameters: CodecParameters) -> dict[str, str]:
    """Encoder options; FFmpeg would silently ignore ``qscale`` with ``global_quality`` here."""
    scale = str(jpeg_quantiser_scale(parameters.quality_within(1, 100, DEFAULT_QUALITY)))
    return {"qmin": scale, "qmax": scale, "huffman": "optimal"}


def webp_options(parameters: CodecParameters) -> dict[str, str]:
    """Encoder options."""
    quality = str(parameters.quality_within(1, 100, DEFAULT_QUALITY))
    return {"quality": quality, "compression_level": str(WEBP_METHOD), "lossless": "0"}


class StillEncoder(Encoder):
    """Encodes each frame as a complete image file; every packet is a keyframe."""

    def __init__(self, parameters: CodecParameters, still: StillFormat, options: dict[str, str]) -> None:
        super().__init__(parameters)
        size = (parameters.height, parameters.width)
        self.context: VideoCodecContext | None = open_encoder(
            still.encoder, parameters, size=size, full_range=still.full_range, options=options
        )
        self.to_picture = BgrToI420(*size, full_range=still.full_range)
        self.pixel_format = "yuvj420p" if still.full_range else "yuv420p"
        self.frame_count = 0

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
            check_container(data, self.parameters.name)
            frame = decode_single(self.context, data, self.parameters)
            read_picture(frame, self.to_image.picture, size, self.still.pixel_formats, self.parameters.name)
        except CodecError:
            self.context = open_decoder(self.still.decoder, self.parameters)
            raise
        return self.to_image()

    def close(self) -> None:
        """Release the codec."""
        self.context = None


def check_container(data: bytes, name: str) -> None:
    """Check that a file is whole: JPEG from SOI to EOI, WebP with the RIFF length it states.

    FFmpeg pads truncated images with grey instead of complaining.

    Raises:
        CodecError: The file is cut, has trailing bytes or isn't of this kind.
    """
    if name == "jpeg":
        whole = data[:3] == b"\xff\xd8\xff" and data[-2:] == b"\xff\xd9" and data.count(b"\xff\xd8\xff") == 1
    else:
        stated = int.from_bytes(data[4:8], "little") + 8
        whole = data[:4] == b"RIFF" and data[8:12] == b"WEBP" and stated == len(data)
    if not whole:
        raise CodecError(
            f"packet of {len(data)} bytes isn't one whole {name} file; it is cut, joined or of another codec"
        )
