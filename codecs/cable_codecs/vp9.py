"""VP9 without delay: libvpx in its real-time mode, FFmpeg's decoder; the choice free of the GPL."""

from __future__ import annotations

from cable_codecs.base import CodecParameters
from cable_codecs.hardware import qsv, vaapi
from cable_codecs.video_format import EncoderSpec, Rate, VideoFormat
from cable_codecs.vp9_header import summarise_vp9

DEFAULT_CRF = 43
DEFAULT_PRESET = "8"


def vpx_options(parameters: CodecParameters, crf: int, rate: Rate) -> dict[str, str]:
    """One pass in real time, without alternate reference frames, which would be a second picture in a packet."""
    options = {
        "deadline": "realtime",
        "cpu-used": parameters.preset or DEFAULT_PRESET,
        "lag-in-frames": "0",
        "auto-alt-ref": "0",
        "row-mt": str(int(parameters.threads > 1)),
    }
    if rate.target is not None:
        fixed = str(rate.target)
        return options | {"minrate": fixed, "maxrate": fixed, "bufsize": str(rate.buffer)}
    if rate.ceiling is not None:
        return options | {"crf": str(crf), "b": str(rate.ceiling), "bufsize": str(rate.buffer)}
    return options | {"crf": str(crf), "b": "0"}


VP9 = VideoFormat(
    name="vp9",
    decoder="vp9",
    software=EncoderSpec("libvpx-vp9", vpx_options, caps_quality=True),
    hardware=(qsv("vp9"), vaapi("vp9")),
    quality_range=(0, 63),
    default_quality=DEFAULT_CRF,
    summarise=summarise_vp9,
    headers="frame header",
)
