"""Codecs by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

from cable_codecs.base import CodecParameters, Decoder, Encoder
from cable_codecs.errors import CodecError, CodecUnavailableError
from cable_codecs.h264 import H264Decoder, H264Encoder
from cable_codecs.still import JPEG, WEBP, StillDecoder, StillEncoder, jpeg_options, webp_options


@dataclass(frozen=True, slots=True)
class CodecEntry:
    """How to open one codec."""

    encoder: Callable[[CodecParameters], Encoder]
    decoder: Callable[[CodecParameters], Decoder]


CODECS: Mapping[str, CodecEntry] = {
    "jpeg": CodecEntry(
        lambda parameters: StillEncoder(parameters, JPEG, jpeg_options(parameters)),
        lambda parameters: StillDecoder(parameters, JPEG),
    ),
    "webp": CodecEntry(
        lambda parameters: StillEncoder(parameters, WEBP, webp_options(parameters)),
        lambda parameters: StillDecoder(parameters, WEBP),
    ),
    "h264": CodecEntry(H264Encoder, H264Decoder),
}


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
