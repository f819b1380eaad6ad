"""Which encoder is used, what happens where the wanted one is missing, and what the probe reports."""

from __future__ import annotations

import dataclasses

import av
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, CodecUnavailableError, create_decoder, create_encoder
from cable_codecs.encoder_choice import choose_encoder, trial_failure
from cable_codecs.h264 import H264
from cable_codecs.probe import probe_codecs, probe_video
from cable_codecs.registry import CODECS, STILL_CODECS, VIDEO_FORMATS, default_quality
from cable_codecs.video_encoder import VideoEncoder
from cable_codecs.video_format import EncoderSpec
from codec_images import CODECS as NAMES
from codec_images import STILLS, VIDEOS, luma_psnr, moving_clip, natural_image

SOFTWARE = {"h264": "libx264", "hevc": "libx265", "av1": "libsvtav1", "vp9": "libvpx-vp9"}


def test_registry_has_every_codec():
    assert tuple(CODECS) == NAMES
    assert frozenset(STILLS) == STILL_CODECS
    assert tuple(VIDEO_FORMATS) == VIDEOS
    assert [default_quality(name) for name in NAMES] == [75, 75, 75, None, 28, 30, 33, 43]
    with pytest.raises(CodecUnavailableError, match="jpeg"):
        default_quality("mpeg2")


@pytest.mark.parametrize("name", VIDEOS)
def test_software_by_default_and_by_name(name):
    for wanted in (None, SOFTWARE[name]):
        encoder = create_encoder(CodecParameters(name, 128, 96, encoder=wanted))
        assert encoder.implementation == SOFTWARE[name]
        assert encoder.fallback_reason is None


@pytest.mark.parametrize("name", VIDEOS)
def test_unknown_encoder_is_refused_with_the_known_ones(name):
    with pytest.raises(CodecUnavailableError, match=rf"'quick'.*{SOFTWARE[name]}.*auto-hardware"):
        create_encoder(CodecParameters(name, 128, 96, encoder="quick"))


def broken_spec(**changes) -> EncoderSpec:
    """An encoder that passes for hardware and isn't in any FFmpeg."""
    return EncoderSpec("h264_nowhere", lambda *_: {}, hardware=True, **changes)


def working_spec(**changes) -> EncoderSpec:
    """libx264 passing for hardware."""
    return dataclasses.replace(H264.software, hardware=True, live_bitrate=False, **changes)


def h264_with(*hardware: EncoderSpec):
    software = dataclasses.replace(H264.software, library="libx264rgb")
    return dataclasses.replace(H264, software=software, hardware=hardware)


def test_missing_hardware_falls_back_with_a_reason():
    video = dataclasses.replace(H264, hardware=(broken_spec(),))
    for wanted in ("h264_nowhere", "auto-hardware"):
        encoder = VideoEncoder(CodecParameters("h264", 128, 96, encoder=wanted), video)
        assert encoder.implementation == "libx264"
        assert encoder.fallback_reason == "libx264 is used instead: h264_nowhere isn't in this FFmpeg"
        assert encoder.encode(moving_clip(1)[0]).keyframe


def test_auto_hardware_takes_the_first_that_works():
    video = h264_with(broken_spec(), working_spec())
    encoder = VideoEncoder(CodecParameters("h264", 128, 96, encoder="auto-hardware"), video)
    assert (encoder.implementation, encoder.fallback_reason) == ("libx264", None)
    spec, reason = choose_encoder(CodecParameters("h264", 128, 96, encoder="h264_nowhere"), video)
    assert spec is video.software
    assert "h264_nowhere" in str(reason)


def test_hardware_that_delays_or_lacks_quality_is_found_out():
    late = working_spec(options=lambda *_: {"preset": "veryfast"})
    assert "expected exactly one" in str(trial_failure(late, H264, rated=False))
    rate_only = working_spec(constant_quality=False)
    assert "bitrate_kbps" in str(trial_failure(rate_only, H264, rated=False))
    assert trial_failure(rate_only, H264, rated=True) is None
    no_headers = working_spec(
        options=lambda *_: {"preset": "veryfast", "tune": "zerolatency", "x264-params": "repeat-headers=0"}
    )
    assert "headers" in str(trial_failure(no_headers, H264, rated=False))


def test_hardware_that_opens_in_the_trial_only_falls_back_too(monkeypatch):
    picky = working_spec(options=lambda parameters, *_: {"preset": "none" if parameters.width != 320 else "veryfast",
                                                         "tune": "zerolatency", "forced-idr": "1"})  # fmt: skip
    video = dataclasses.replace(H264, hardware=(dataclasses.replace(picky, library="libx264rgb"),))
    monkeypatch.setattr("cable_codecs.encoder_choice.trial_failure", lambda *_: None)
    encoder = VideoEncoder(CodecParameters("h264", 128, 96, encoder="libx264rgb"), video)
    assert encoder.implementation == "libx264"
    assert "can't be opened" in str(encoder.fallback_reason)


@pytest.mark.parametrize("size", [(128, 96), (127, 95)])
def test_frames_with_interleaved_chroma_give_the_same_stream(size):
    """Hardware wants NV12; libx264 takes both, so the conversion can be checked without any."""
    video = h264_with(working_spec(pixel_format="nv12"))
    planar = create_encoder(CodecParameters("h264", *size))
    interleaved = VideoEncoder(CodecParameters("h264", *size, encoder="libx264"), video)
    assert interleaved.spec.pixel_format == "nv12"
    decoder = create_decoder(CodecParameters("h264", *size))
    for image in moving_clip(3, size[1], size[0]):
        data = interleaved.encode(image).data
        assert data == planar.encode(image).data
        assert luma_psnr(image, decoder.decode(data)) > 30


@pytest.mark.parametrize("name", VIDEOS)
def test_presets_reach_the_encoder_and_wrong_ones_are_refused(name):
    slow, fast = {"h264": ("medium", "ultrafast"), "hevc": ("medium", "ultrafast"), "av1": ("7", "12"),
                  "vp9": ("4", "8")}[name]  # fmt: skip
    clip = moving_clip(3)
    streams = []
    for preset in (slow, fast):
        encoder = create_encoder(CodecParameters(name, 128, 96, preset=preset))
        streams.append(b"".join(encoder.encode(image).data for image in clip))
    assert streams[0] != streams[1]
    with pytest.raises(CodecError):
        create_encoder(CodecParameters(name, 128, 96, preset="no such effort"))


def test_probe_names_every_encoder_with_a_reason_or_none():
    probes = probe_codecs()
    assert {probe.codec for probe in probes} == set(NAMES)
    for probe in probes:
        assert probe.usable == (probe.reason is None)
        assert probe.decoder is not None
        if not probe.hardware:
            assert probe.usable
    assert {probe.encoder for probe in probes if probe.codec == "h264"} >= {"libx264", "h264_nvenc", "h264_vaapi"}
    for probe in probes:
        if probe.hardware and probe.encoder not in av.codecs_available:
            assert probe.reason == f"{probe.encoder} isn't in this FFmpeg"


def test_probe_of_hardware_that_works():
    found = probe_video(h264_with(working_spec()), "h264")[1]
    assert (found.encoder, found.hardware, found.usable) == ("libx264", True, True)


def region(height: int, width: int) -> np.ndarray:
    roi = np.zeros((height, width), bool)
    roi[16:64, 32:96] = True
    return roi


@pytest.mark.parametrize("name", ["h264", "hevc", "vp9"])
def test_background_offset_saves_bytes_outside_the_region_only(name):
    clip = [natural_image(192, 256, seed) for seed in range(6)]
    roi = region(192, 256)
    totals, inside, outside = [], [], []
    for offset in (0.0, 0.4):
        parameters = CodecParameters(name, 256, 192, quality=20, background_offset=offset)
        encoder, decoder = create_encoder(parameters), create_decoder(parameters)
        packets = [encoder.encode(image, roi).data for image in clip]
        last = [decoder.decode(packet) for packet in packets][-1].astype(float)
        squares = ((last - clip[-1]) ** 2).mean(axis=2)
        totals.append(sum(map(len, packets)))
        inside.append(squares[roi].mean())
        outside.append(squares[~roi].mean())
    assert totals[1] < 0.8 * totals[0]
    assert inside[1] < 1.3 * inside[0]
    assert outside[1] > 2 * outside[0]


def test_background_offset_is_refused_where_it_would_be_ignored():
    with pytest.raises(CodecError, match="ignores quantiser offsets"):
        create_encoder(CodecParameters("av1", 128, 96, background_offset=0.3))
