"""Encoders in hardware: how to open each for live video, one packet per frame.

Which of them works is found out by a trial on the machine (`video_trial`). All are opened anew where the rate
changes, since whether a driver heeds a new rate can't be seen from outside.
"""

from __future__ import annotations

from cable_codecs.base import CodecParameters
from cable_codecs.video_format import EncoderSpec, Rate


def rate_options(rate: Rate) -> dict[str, str]:
    """The limits of a constant bit rate in FFmpeg's common options; the rate itself is set on the context."""
    if rate.target is None:
        return {}
    return {"maxrate": str(rate.target), "bufsize": str(rate.buffer)}


def nvenc(codec: str) -> EncoderSpec:
    """NVIDIA's encoder."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        common = {"preset": "p3", "tune": "ull", "zerolatency": "1", "delay": "0", "rc-lookahead": "0"}
        common |= {"forced-idr": "1", "no-scenecut": "1"}
        if rate.target is None:
            # AV1 counts its quantiser steps in 0..255.
            return common | {"rc": "constqp", "qp": str(quality * 4 if codec == "av1" else quality)}
        return common | {"rc": "cbr"} | rate_options(rate)

    return EncoderSpec(
        f"{codec}_nvenc",
        options,
        hardware=True,
        needs="it needs an NVIDIA driver and a GPU with an encoder (A100, H100 and H200 have none)",
    )


def qsv(codec: str) -> EncoderSpec:
    """Intel Quick Sync Video."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        common = {"preset": "veryfast", "async_depth": "1", "look_ahead": "0", "forced_idr": "1"}
        if codec != "h264":
            del common["look_ahead"]
        if rate.target is None:
            return common | {"global_quality": str(quality)}
        return common | rate_options(rate)

    return EncoderSpec(
        f"{codec}_qsv",
        options,
        hardware=True,
        pixel_format="nv12",
        needs="it needs an Intel GPU and its oneVPL runtime",
    )


def amf(codec: str) -> EncoderSpec:
    """AMD's Advanced Media Framework."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        common = {"usage": "ultralowlatency", "quality": "speed"}
        if codec == "h264":
            common["header_spacing"] = "1"
        elif codec == "hevc":
            common["header_insertion_mode"] = "idr"
        if rate.target is None:
            step = str(quality * 4 if codec == "av1" else quality)
            return common | {"rc": "cqp", "qp_i": step, "qp_p": step}
        return common | {"rc": "cbr"} | rate_options(rate)

    return EncoderSpec(
        f"{codec}_amf",
        options,
        hardware=True,
        pixel_format="nv12",
        needs="it needs an AMD GPU and its AMF runtime",
    )


def videotoolbox(codec: str) -> EncoderSpec:
    """Apple's encoder."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        return {"realtime": "1", "prio_speed": "1"} | rate_options(rate)

    return EncoderSpec(f"{codec}_videotoolbox", options, hardware=True, pixel_format="nv12", constant_quality=False)


def media_foundation(codec: str) -> EncoderSpec:
    """The encoder that Windows offers."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        return {"hw_encoding": "1", "scenario": "live_streaming", "rate_control": "cbr"}

    return EncoderSpec(f"{codec}_mf", options, hardware=True, pixel_format="nv12", constant_quality=False)


def v4l2m2m(codec: str) -> EncoderSpec:
    """Video4Linux memory-to-memory devices, found in small boards."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        return {"num_output_buffers": "4", "num_capture_buffers": "4"}

    return EncoderSpec(
        f"{codec}_v4l2m2m",
        options,
        hardware=True,
        constant_quality=False,
        needs="it needs a /dev/video* device that encodes",
    )


def vaapi(codec: str) -> EncoderSpec:
    """The Video Acceleration API, listed so that it is refused by name."""

    def options(parameters: CodecParameters, quality: int, rate: Rate) -> dict[str, str]:
        return {"async_depth": "1"} | rate_options(rate)

    return EncoderSpec(
        f"{codec}_vaapi",
        options,
        hardware=True,
        needs="PyAV can't hand it the GPU surfaces that it takes; on Intel use qsv",
    )
