"""HEVC without delay: x265 in, FFmpeg's decoder out, Annex B packets between them."""

from __future__ import annotations

from cable_codecs.annexb import summarise_hevc
from cable_codecs.base import CodecParameters
from cable_codecs.hardware import amf, media_foundation, nvenc, qsv, v4l2m2m, vaapi, videotoolbox
from cable_codecs.video_format import EncoderSpec, Rate, VideoFormat

DEFAULT_CRF = 30
DEFAULT_PRESET = "ultrafast"


def x265_options(parameters: CodecParameters, crf: int, rate: Rate) -> dict[str, str]:
    """Zero latency, one frame at a time, parameter sets before every keyframe, no keyframes at scene cuts."""
    own: dict[str, object] = {
        "repeat-headers": 1,
        "frame-threads": 1,
        "pools": parameters.threads if parameters.threads > 1 else "none",
        "bframes": 0,
        "rc-lookahead": 0,
        "scenecut": 0,
        "open-gop": 0,
        "info": 0,
        "log-level": "none",
    }
    if parameters.background_offset > 0:
        # Quantiser offsets go through adaptive quantisation, which fast presets switch off.
        own |= {"aq-mode": 1, "aq-strength": 1.0}
    options = {"preset": parameters.preset or DEFAULT_PRESET, "tune": "zerolatency", "forced-idr": "1"}
    if rate.target is not None:
        own["strict-cbr"] = 1
        options |= {"maxrate": str(rate.target), "bufsize": str(rate.buffer)}
    else:
        options["crf"] = str(crf)
        if rate.ceiling is not None:
            options |= {"maxrate": str(rate.ceiling), "bufsize": str(rate.buffer)}
    return options | {"x265-params": ":".join(f"{key}={value}" for key, value in own.items())}


HEVC = VideoFormat(
    name="hevc",
    decoder="hevc",
    software=EncoderSpec("libx265", x265_options, caps_quality=True),
    hardware=(
        nvenc("hevc"),
        qsv("hevc"),
        amf("hevc"),
        videotoolbox("hevc"),
        media_foundation("hevc"),
        v4l2m2m("hevc"),
        vaapi("hevc"),
    ),
    quality_range=(0, 51),
    default_quality=DEFAULT_CRF,
    summarise=summarise_hevc,
    headers="VPS, SPS and PPS",
)
