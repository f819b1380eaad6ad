"""H.264 without delay: x264 in, FFmpeg's decoder out, Annex B packets between them."""

from __future__ import annotations

from cable_codecs.annexb import summarise_h264
from cable_codecs.base import CodecParameters
from cable_codecs.hardware import amf, media_foundation, nvenc, qsv, v4l2m2m, vaapi, videotoolbox
from cable_codecs.video_format import EncoderSpec, Rate, VideoFormat

DEFAULT_CRF = 28
DEFAULT_PRESET = "veryfast"


def x264_options(parameters: CodecParameters, crf: int, rate: Rate) -> dict[str, str]:
    """Zero latency, IDR pictures where asked for, none at scene cuts: when to pay for one is the caller's choice.

    A later change of the bit rate is silently ignored unless the encoder is opened at its ceiling, with the
    maximum equal to the average rate.
    """
    options = {
        "preset": parameters.preset or DEFAULT_PRESET,
        "tune": "zerolatency",
        "profile": "high",
        "forced-idr": "1",
        "sc_threshold": "0",
        "intra-refresh": str(int(parameters.intra_refresh)),
    }
    if parameters.background_offset > 0:
        # Quantiser offsets go through adaptive quantisation, which some presets switch off.
        options["aq-mode"] = "1"
    if rate.target is None:
        options["crf"] = str(crf)
        if crf == 0 and rate.ceiling is None:
            # High profile has no lossless mode, which CRF 0 is.
            options["profile"] = "high444"
    if rate.ceiling is not None:
        options |= {"maxrate": str(rate.ceiling), "bufsize": str(rate.buffer)}
    return options


H264 = VideoFormat(
    name="h264",
    decoder="h264",
    software=EncoderSpec("libx264", x264_options, live_bitrate=True, caps_quality=True),
    hardware=(
        nvenc("h264"),
        qsv("h264"),
        amf("h264"),
        videotoolbox("h264"),
        media_foundation("h264"),
        v4l2m2m("h264"),
        vaapi("h264"),
    ),
    quality_range=(0, 51),
    default_quality=DEFAULT_CRF,
    summarise=summarise_h264,
    headers="SPS and PPS",
)
