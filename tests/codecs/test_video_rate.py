"""Constant bit rate: held over two seconds, changed on the fly, and what it costs where it can't be."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import av
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from codec_images import STILLS, VIDEOS, moving_clip, natural_image

CLIP = Path(__file__).resolve().parents[3] / "shared" / "data" / "highway-540p" / "solidWhiteRight.mp4"
FPS = 25
WINDOW = 2 * FPS
with_clip = pytest.mark.skipif(not CLIP.is_file(), reason=f"the clip {CLIP.name} isn't in ../shared/data")


def read_clip(count: int, step: int = 1) -> list[np.ndarray]:
    """Frames of the drive, half size, so that the tests stay fast."""
    with av.open(str(CLIP)) as container:
        frames = islice(container.decode(video=0), 0, count * step, step)
        return [np.ascontiguousarray(frame.to_ndarray(format="bgr24")[::2, ::2]) for frame in frames]


def noisy_clip(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    base = natural_image(192, 320)
    return [
        np.clip(np.roll(base, 3 * index, axis=1).astype(int) + rng.normal(0, 6, base.shape), 0, 255).astype(np.uint8)
        for index in range(count)
    ]


def window_kbps(packets, fps: float = FPS) -> np.ndarray:
    """The rate over every window of two seconds."""
    bits = np.array([8 * len(packet.data) for packet in packets], float)
    length = int(2 * fps)
    return np.convolve(bits, np.ones(length), "valid") / 2 / 1000


@with_clip
@pytest.mark.parametrize("name", VIDEOS)
def test_rate_is_held_over_two_seconds_of_a_real_drive(name):
    clip = read_clip(100)
    height, width = clip[0].shape[:2]
    parameters = CodecParameters(name, width, height, frame_rate=FPS, bitrate_kbps=300)
    with create_encoder(parameters) as encoder:
        packets = [encoder.encode(image) for image in clip]
    rates = window_kbps(packets[FPS:])
    assert rates.min() >= 270
    assert rates.max() <= 330
    assert encoder.reopen_count == 0


@with_clip
def test_rate_is_held_at_a_low_frame_rate():
    clip = read_clip(70, step=3)
    height, width = clip[0].shape[:2]
    parameters = CodecParameters("h264", width, height, frame_rate=FPS / 3, bitrate_kbps=300)
    with create_encoder(parameters) as encoder:
        rates = window_kbps([encoder.encode(image) for image in clip][8:], FPS / 3)
    assert rates.min() >= 270
    assert rates.max() <= 330


@with_clip
def test_x264_follows_a_live_rate_without_a_keyframe():
    clip = read_clip(200)
    height, width = clip[0].shape[:2]
    encoder = create_encoder(CodecParameters("h264", width, height, frame_rate=FPS, bitrate_kbps=300))
    packets = []
    for index, image in enumerate(clip):
        if index in (75, 125):
            encoder.set_bitrate({75: 150, 125: 320}[index])
        packets.append(encoder.encode(image))
    assert encoder.reopen_count == 0
    assert [index for index, packet in enumerate(packets) if packet.keyframe] == [0]
    assert window_kbps(packets[25:75]) == pytest.approx(300, rel=0.1)
    assert window_kbps(packets[175:200] + packets[150:175]) == pytest.approx(320, rel=0.12)
    assert window_kbps(packets[100:125] * 2) == pytest.approx(150, rel=0.12)


@pytest.mark.parametrize("name", ["hevc", "av1", "vp9"])
def test_other_encoders_are_opened_anew_for_a_new_rate(name):
    clip = noisy_clip(60)
    parameters = CodecParameters(name, 320, 192, frame_rate=FPS, bitrate_kbps=400)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    packets = []
    for index, image in enumerate(clip):
        if index == 30:
            encoder.set_bitrate(600)
            encoder.set_bitrate(900)
        packets.append(encoder.encode(image))
        decoder.decode(packets[-1].data)
    assert encoder.reopen_count == 1
    assert [index for index, packet in enumerate(packets) if packet.keyframe] == [0, 30]
    sizes = [sum(len(packet.data) for packet in part) for part in (packets[10:30], packets[40:60])]
    assert sizes[1] > 1.5 * sizes[0]


def test_x264_opens_anew_only_where_its_buffer_would_be_too_short():
    clip = noisy_clip(60)
    parameters = CodecParameters("h264", 320, 192, frame_rate=FPS, bitrate_kbps=200, buffer_seconds=0.16)
    encoder = create_encoder(parameters)
    packets = []
    for index, image in enumerate(clip):
        if index == 20:
            encoder.set_bitrate(800)
        packets.append(encoder.encode(image))
    assert encoder.reopen_count == 1
    assert packets[20].keyframe
    assert sum(len(packet.data) for packet in packets[35:]) * 8 / 1000 == pytest.approx(800, rel=0.15)


@pytest.mark.parametrize("name", VIDEOS)
def test_the_same_rate_again_costs_nothing(name):
    encoder = create_encoder(CodecParameters(name, 128, 96, bitrate_kbps=200))
    clip = moving_clip(4)
    encoder.encode(clip[0])
    for image in clip[1:]:
        encoder.set_bitrate(200)
        assert not encoder.encode(image).keyframe
    assert encoder.reopen_count == 0


@pytest.mark.parametrize("name", ["h264", "hevc", "vp9"])
def test_ceiling_limits_constant_quality(name):
    clip = noisy_clip(60)
    quality = {"h264": 12, "hevc": 12, "vp9": 8}[name]
    free = create_encoder(CodecParameters(name, 320, 192, frame_rate=FPS, quality=quality))
    capped = create_encoder(CodecParameters(name, 320, 192, frame_rate=FPS, quality=quality, ceiling_kbps=500))
    rates = [[len(encoder.encode(image).data) * 8 * FPS / 1000 for image in clip] for encoder in (free, capped)]
    assert np.mean(rates[0][10:]) > 900
    assert np.mean(rates[1][10:]) < 600


@pytest.mark.parametrize("name", VIDEOS)
def test_quality_can_be_changed_at_the_price_of_a_keyframe(name):
    clip = moving_clip(6)
    encoder = create_encoder(CodecParameters(name, 128, 96, quality=45))
    sizes = [len(encoder.encode(image, keyframe=True).data) for image in clip[:3]]
    encoder.set_quality(20)
    packet = encoder.encode(clip[3])
    assert packet.keyframe
    assert encoder.reopen_count == 1
    assert len(packet.data) > 1.5 * max(sizes)
    with pytest.raises(CodecError, match="quality must be"):
        encoder.set_quality(64)


def test_misuse_is_refused():
    with pytest.raises(CodecError, match="under a ceiling"):
        create_encoder(CodecParameters("av1", 64, 48, ceiling_kbps=500))
    constant_quality = create_encoder(CodecParameters("h264", 64, 48))
    with pytest.raises(CodecError, match="bitrate_kbps"):
        constant_quality.set_bitrate(100)
    constant_rate = create_encoder(CodecParameters("h264", 64, 48, bitrate_kbps=100, ceiling_kbps=150))
    with pytest.raises(CodecError, match="ceiling of 150"):
        constant_rate.set_bitrate(151)
    with pytest.raises(CodecError, match="holds its bit rate"):
        constant_rate.set_quality(20)
    for rate in (0, -5, float("nan"), float("inf")):
        with pytest.raises(CodecError, match="bit rate"):
            constant_rate.set_bitrate(rate)
    for name in STILLS:
        with pytest.raises(CodecError, match="no bit rate"):
            create_encoder(CodecParameters(name, 64, 48)).set_bitrate(100)


@pytest.mark.parametrize(
    "settings_",
    [
        {"bitrate_kbps": 0.0},
        {"bitrate_kbps": float("nan")},
        {"ceiling_kbps": -1.0},
        {"ceiling_kbps": 50.0, "bitrate_kbps": 100.0},
        {"buffer_seconds": 0.0},
        {"background_offset": 1.5},
    ],
)
def test_rates_out_of_range_are_refused(settings_):
    with pytest.raises(CodecError, match=next(iter(settings_))):
        CodecParameters(**{"name": "h264", "width": 64, "height": 48, **settings_})
