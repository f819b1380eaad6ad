"""Which codecs and encoders work on this machine, each found out by using it."""

from __future__ import annotations

from dataclasses import dataclass

from cable_codecs.base import CodecParameters
from cable_codecs.encoder_choice import trial_failure
from cable_codecs.errors import CodecError
from cable_codecs.registry import CODECS, STILL_CODECS, VIDEO_FORMATS
from cable_codecs.video_format import VideoFormat

PROBE_SIZE = 64


@dataclass(frozen=True, slots=True)
class CodecProbe:
    """One encoder of one codec."""

    codec: str
    """Name for `CodecParameters.name`."""
    encoder: str
    """The library's name; of a video codec one for `CodecParameters.encoder`."""
    hardware: bool
    usable: bool
    reason: str | None
    """Why it isn't usable."""
    decoder: str | None
    """The library that decodes, None where it doesn't open: this machine then can't receive the codec."""


def probe_codecs() -> list[CodecProbe]:
    """Every encoder of every codec, software before hardware; takes about a second."""
    return [probe for name in CODECS for probe in probe_codec(name)]


def probe_codec(name: str) -> list[CodecProbe]:
    """Every encoder of one registered codec."""
    parameters = CodecParameters(name, PROBE_SIZE, PROBE_SIZE)
    decoder: str | None = None
    try:
        with CODECS[name].decoder(parameters) as opened:
            decoder = opened.implementation
    except CodecError:
        pass
    if name in STILL_CODECS:
        try:
            with CODECS[name].encoder(parameters) as encoder:
                return [CodecProbe(name, encoder.implementation, False, True, None, decoder)]
        except CodecError as error:
            return [CodecProbe(name, name, False, False, str(error), decoder)]
    return probe_video(VIDEO_FORMATS[name], decoder)


def probe_video(video: VideoFormat, decoder: str | None) -> list[CodecProbe]:
    """Every encoder of a video codec."""
    probes = []
    for spec in (video.software, *video.hardware):
        reason = trial_failure(spec, video, rated=not spec.constant_quality)
        probes.append(CodecProbe(video.name, spec.library, spec.hardware, reason is None, reason, decoder))
    return probes
