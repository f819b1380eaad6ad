"""Opening video encoders, and finding by trial which of them work on this machine."""

from __future__ import annotations

import os
from functools import cache

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame

from cable_codecs.base import CodecParameters
from cable_codecs.colour import Plane, empty_picture
from cable_codecs.errors import CodecError, CodecUnavailableError
from cable_codecs.ffmpeg import encode_single, frame_of_picture, nv12_frame_of_picture, open_encoder
from cable_codecs.quantiser_offset import require_offsets
from cable_codecs.video_format import EncoderSpec, Rate, VideoFormat, opening_rate

AUTO_HARDWARE = "auto-hardware"
TRIAL_SIZE = (240, 320)
TRIAL_KBPS = 500.0
TRIAL_KEYFRAMES = (True, False, True)


def open_video(
    spec: EncoderSpec, video: VideoFormat, parameters: CodecParameters, quality: int, kbps: float | None
) -> VideoCodecContext:
    """Open an encoder.

    Args:
        spec: Which encoder.
        video: Its codec.
        parameters: What the caller asked for.
        quality: CRF in force.
        kbps: Bit rate in force, None for constant quality.

    Raises:
        CodecError: The encoder isn't in this FFmpeg, refuses the settings, or lacks what is asked for.
    """
    if parameters.intra_refresh and spec.library != "libx264":
        raise CodecError(f"{spec.library} has no intra_refresh; use libx264 or keyframes")
    if kbps is None and not spec.constant_quality:
        raise CodecError(f"{spec.library} has no constant quality; set bitrate_kbps")
    if kbps is None and parameters.ceiling_kbps is not None and not spec.caps_quality:
        raise CodecError(f"{spec.library} can't hold a quality under a ceiling; set bitrate_kbps as well")
    if parameters.background_offset > 0:
        require_offsets(spec.library, spec.options(parameters, quality, Rate(None, None, 0)))
    # SVT-AV1 otherwise writes to stderr at every opening and closing; a level set from outside stays.
    os.environ.setdefault("SVT_LOG", "0")
    rate = opening_rate(parameters, kbps)
    context = open_encoder(
        spec.library,
        parameters,
        size=video.coded_size(parameters),
        full_range=False,
        options=spec.options(parameters, quality, rate),
        interval=parameters.keyframe_interval,
        bit_rate=rate.ceiling if spec.live_bitrate and rate.target is not None else rate.target,
        pixel_format=spec.pixel_format,
    )
    if spec.live_bitrate and rate.target is not None:
        # Only after opening at the ceiling does the encoder heed a rate, see `x264_options`.
        context.bit_rate = rate.target
    return context


def frame_for(spec: EncoderSpec, picture: Plane, coded: tuple[int, int]) -> VideoFrame:
    """The frame of an I420 picture in the encoder's pixel format."""
    if spec.pixel_format == "nv12":
        return nv12_frame_of_picture(picture)
    return frame_of_picture(picture, *coded, spec.pixel_format)


@cache
def trial_failure(spec: EncoderSpec, video: VideoFormat, rated: bool) -> str | None:
    """Why an encoder is no use for live video here, None where it is; found by encoding three small frames.

    Args:
        spec: The encoder.
        video: Its codec.
        rated: At a constant bit rate instead of constant quality.
    """
    if spec.library not in av.codecs_available:
        return f"{spec.library} isn't in this FFmpeg"
    parameters = CodecParameters(video.name, width=TRIAL_SIZE[1], height=TRIAL_SIZE[0])
    try:
        context = open_video(spec, video, parameters, video.default_quality, TRIAL_KBPS if rated else None)
    except CodecError as error:
        return f"{spec.library} doesn't open here: {spec.needs}" if spec.needs else str(error)
    picture = empty_picture(*TRIAL_SIZE)
    try:
        for number, keyframe in enumerate(TRIAL_KEYFRAMES):
            picture[:] = np.arange(picture.shape[1], dtype=np.uint8) + 4 * number
            frame = frame_for(spec, picture, TRIAL_SIZE)
            frame.pts = number
            frame.pict_type = PictureType.I if keyframe else PictureType.NONE
            summary = video.summarise(encode_single(context, frame, spec.library))
            if (summary.picture_count, summary.keyframe) != (1, keyframe) or (keyframe and not summary.has_headers):
                return (
                    f"{spec.library} doesn't make one picture per packet, with keyframes where asked for and their "
                    "headers in band"
                )
    except CodecError as error:
        return str(error)
    return None


def choose_encoder(parameters: CodecParameters, video: VideoFormat) -> tuple[EncoderSpec, str | None]:
    """The encoder for what the caller asked, and why it isn't that one where it isn't.

    Raises:
        CodecUnavailableError: The codec has no encoder of that name.
    """
    asked = parameters.encoder
    if asked is None:
        return video.software, None
    rated = parameters.bitrate_kbps is not None
    if asked != AUTO_HARDWARE:
        spec = video.find_encoder(asked)
        if spec is None:
            names = [one.library for one in (video.software, *video.hardware)]
            raise CodecUnavailableError(
                asked, [*names, AUTO_HARDWARE], f"{video.name} has no encoder of that name", kind="encoder"
            )
        candidates: tuple[EncoderSpec, ...] = (spec,)
    else:
        candidates = video.hardware
    reasons = []
    for spec in candidates:
        reason = trial_failure(spec, video, rated) if spec.hardware else None
        if reason is None:
            return spec, None
        reasons.append(reason)
    return video.software, f"{video.software.library} is used instead: {'; '.join(reasons)}"
