"""Codecs by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

from cable_codecs.av1 import AV1
from cable_codecs.base import CodecParameters, Decoder, Encoder
from cable_codecs.errors import CodecError, CodecUnavailableError
from cable_codecs.h264 import H264
from cable_codecs.hevc import HEVC
from cable_codecs.jpeg import JpegDecoder, JpegEncoder
from cable_codecs.still import DEFAULT_QUALITY, JPEG, WEBP, StillDecoder, StillEncoder, StillFormat
from cable_codecs.video_decoder import VideoDecoder
from cable_codecs.video_encoder import VideoEncoder
from cable_codecs.video_format import VideoFormat
from cable_codecs.vp9 import VP9
from cable_codecs.webp_lossless import LosslessWebpDecoder, LosslessWebpEncoder


@dataclass(frozen=True, slots=True)
class CodecEntry:
    """How to open one codec."""

    encoder: Callable[[CodecParameters], Encoder]
    decoder: Callable[[CodecParameters], Decoder]


def still_entry(still: StillFormat) -> CodecEntry:
    """The entry of an image codec that FFmpeg runs."""
    return CodecEntry(
        lambda parameters: StillEncoder(parameters, still), lambda parameters: StillDecoder(parameters, still)
    )


def video_entry(video: VideoFormat) -> CodecEntry:
    """The entry of a video codec."""
    return CodecEntry(
        lambda parameters: VideoEncoder(parameters, video), lambda parameters: VideoDecoder(parameters, video)
    )


VIDEO_FORMATS: Mapping[str, VideoFormat] = {video.name: video for video in (H264, HEVC, AV1, VP9)}

CODECS: Mapping[str, CodecEntry] = {
    "jpeg": CodecEntry(JpegEncoder, JpegDecoder),
    "jpeg-ffmpeg": still_entry(JPEG),
    "webp": still_entry(WEBP),
    "webp-lossless": CodecEntry(LosslessWebpEncoder, LosslessWebpDecoder),
    **{name: video_entry(video) for name, video in VIDEO_FORMATS.items()},
}

STILL_CODECS = frozenset(CODECS) - frozenset(VIDEO_FORMATS)
"""Those whose every packet stands alone."""


def default_quality(name: str) -> int | None:
    """The quality in force where none is given, None for lossless codecs.

    Raises:
        CodecUnavailableError: Unknown codec.
    """
    if name not in CODECS:
        raise CodecUnavailableError(name, available_codecs())
    if name in VIDEO_FORMATS:
        return VIDEO_FORMATS[name].default_quality
    return None if name == "webp-lossless" else DEFAULT_QUALITY


@cache
def unavailability(name: str) -> str | None:
    """Why a registered codec can't be used here, None where it can; found out by opening it once."""
    parameters = CodecParameters(name, width=64, height=64)
    try:
        CODECS[name].encoder(parameters).close()
        CODECS[name].decoder(parameters).close()
    except CodecError as error:
        return str(error)
    return None


def available_codecs() -> tuple[str, ...]:
    """Names of the codecs that open on this machine."""
    return tuple(name for name in CODECS if unavailability(name) is None)


def find_codec(name: str) -> CodecEntry:
    """The codec of a name.

    Raises:
        CodecUnavailableError: Unknown, or this machine's FFmpeg can't open it.
    """
    if name not in CODECS:
        raise CodecUnavailableError(name, available_codecs())
    reason = unavailability(name)
    if reason is not None:
        raise CodecUnavailableError(name, available_codecs(), reason)
    return CODECS[name]


def create_encoder(parameters: CodecParameters) -> Encoder:
    """Open an encoder.

    Raises:
        CodecUnavailableError: The codec is unknown or can't be opened on this machine.
        CodecError: The parameters don't fit the codec.
    """
    return find_codec(parameters.name).encoder(parameters)


def create_decoder(parameters: CodecParameters) -> Decoder:
    """Open a decoder; ``quality`` doesn't matter to it.

    Raises:
        CodecUnavailableError: The codec is unknown or can't be opened on this machine.
        CodecError: The parameters don't fit the codec.
    """
    return find_codec(parameters.name).decoder(parameters)
