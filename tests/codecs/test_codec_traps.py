"""Settings that FFmpeg and OpenCV ignore without a word; each test fails where one of them creeps back in."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from av.codec.context import ThreadType
from av.video.frame import PictureType
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from cable_codecs.encoder_choice import open_video
from cable_codecs.h264 import H264
from codec_images import BEST, CODECS, STILLS, VIDEOS, luma_psnr, moving_clip, natural_image

SIZE = (320, 192)
RATE = 25


def noisy_clip(count: int) -> list[np.ndarray]:
    """A moving picture with fresh noise in each frame, which no encoder can make small by itself."""
    rng = np.random.default_rng(3)
    base = natural_image(SIZE[1], SIZE[0])
    return [
        np.clip(np.roll(base, 3 * index, axis=1).astype(int) + rng.normal(0, 6, base.shape), 0, 255).astype(np.uint8)
        for index in range(count)
    ]


def kbps(packets) -> float:
    return 8 * RATE * sum(len(packet.data) for packet in packets) / len(packets) / 1000


def test_live_bitrate_is_heeded_only_because_the_encoder_is_opened_at_its_ceiling():
    clip = noisy_clip(100)
    parameters = CodecParameters(
        "h264", *SIZE, frame_rate=RATE, bitrate_kbps=300, ceiling_kbps=1200, buffer_seconds=0.5
    )
    encoder = create_encoder(parameters)
    before = [encoder.encode(image) for image in clip[:50]]
    encoder.set_bitrate(900)
    after = [encoder.encode(image) for image in clip[50:]]
    assert encoder.reopen_count == 0
    assert not any(packet.keyframe for packet in after)
    assert kbps(before[25:]) == pytest.approx(300, rel=0.15)
    assert kbps(after[25:]) == pytest.approx(900, rel=0.2)
    # The trap itself: opened with a maximum above the rate, the encoder takes the new rate and ignores it.
    trapped = av.CodecContext.create("libx264", "w")
    trapped.width, trapped.height = SIZE
    trapped.pix_fmt, trapped.framerate, trapped.time_base = "yuv420p", Fraction(RATE), Fraction(1, RATE)
    trapped.bit_rate = 300_000
    trapped.options = {"preset": "veryfast", "tune": "zerolatency", "maxrate": "1200000", "bufsize": "100000"}
    trapped.open()
    trapped.bit_rate = 900_000
    sizes = []
    for index, image in enumerate(clip):
        frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
        frame.pts = index
        sizes.append(sum(packet.size for packet in trapped.encode(frame)))
    assert 8 * RATE * np.mean(sizes[25:]) / 1000 < 500


def test_rate_is_set_on_the_open_context():
    parameters = CodecParameters("h264", *SIZE, frame_rate=RATE, bitrate_kbps=300, ceiling_kbps=1200)
    context = open_video(H264.software, H264, parameters, 28, 300.0)
    assert context.bit_rate == 300_000
    assert context.is_open


@pytest.mark.parametrize("name", VIDEOS)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_packet_comes_out_for_each_frame_that_goes_in(name, threads):
    encoder = create_encoder(CodecParameters(name, 128, 96, threads=threads))
    decoder = create_decoder(CodecParameters(name, 128, 96))
    assert encoder.context.thread_type == ThreadType.SLICE
    assert decoder.context.thread_count == 1
    # Were there any delay, the first calls would raise for want of a packet or picture.
    for image in moving_clip(5):
        assert luma_psnr(image, decoder.decode(encoder.encode(image).data)) > 30


def test_frame_threads_would_delay_packets():
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = 128, 96, "yuv420p"
    context.framerate, context.time_base = Fraction(RATE), Fraction(1, RATE)
    context.thread_count, context.thread_type = 2, ThreadType.FRAME
    context.options = {
        "preset": "veryfast",
        "x264-params": "sliced-threads=0:rc-lookahead=0:sync-lookahead=0:bframes=0",
    }
    frame = av.VideoFrame(128, 96, "yuv420p")
    frame.pts = 0
    assert context.encode(frame) == []


@pytest.mark.parametrize("name", VIDEOS)
def test_picture_types_of_decoded_frames_are_not_echoed(name):
    clip = moving_clip(6)
    first, second = create_encoder(CodecParameters(name, 128, 96)), create_encoder(CodecParameters(name, 128, 96))
    decoder = create_decoder(CodecParameters(name, 128, 96))
    coded = [first.encode(image, keyframe=index == 3) for index, image in enumerate(clip)]
    assert [packet.keyframe for packet in coded] == [True, False, False, True, False, False]
    again = [second.encode(decoder.decode(packet.data)) for packet in coded]
    assert [packet.keyframe for packet in again] == [True] + [False] * 5


def test_a_picture_type_left_on_a_frame_would_force_a_keyframe():
    encoder = create_encoder(CodecParameters("h264", 128, 96))
    encoder.encode(moving_clip(1)[0])
    frame = av.VideoFrame(128, 96, "yuv420p")
    frame.pts, frame.pict_type = 1, PictureType.I
    assert encoder.context.encode(frame)[0].is_keyframe


@pytest.mark.parametrize("name", ["h264", "vp9"])
def test_a_dropped_packet_goes_unnoticed(name):
    """Why the transport numbers its frames: the decoder drifts on without an error until the next keyframe."""
    encoder = create_encoder(CodecParameters(name, 128, 96))
    packets = [encoder.encode(image, keyframe=index == 8).data for index, image in enumerate(moving_clip(10))]
    whole, lossy = create_decoder(CodecParameters(name, 128, 96)), create_decoder(CodecParameters(name, 128, 96))
    pictures = [whole.decode(packet) for packet in packets]
    for packet in packets[:4]:
        lossy.decode(packet)
    drifted = lossy.decode(packets[5])
    assert not lossy.needs_keyframe
    assert not np.array_equal(drifted, pictures[5])
    for index in (8, 9):
        assert np.array_equal(lossy.decode(packets[index]), pictures[index])


def test_hevc_notices_a_dropped_packet_by_its_picture_order_count():
    encoder, decoder = (
        create_encoder(CodecParameters("hevc", 128, 96)),
        create_decoder(CodecParameters("hevc", 128, 96)),
    )
    packets = [encoder.encode(image).data for image in moving_clip(6)]
    for packet in packets[:4]:
        decoder.decode(packet)
    with pytest.raises(CodecError):
        decoder.decode(packets[5])
    assert decoder.needs_keyframe


def colour_chart() -> np.ndarray:
    """Patches of 40x40 pixels, 8 columns by 6 rows, from black to white and all around the hues."""
    grid = [(b, g, r) for b in (16, 128, 240) for g in (16, 96, 176, 240) for r in (16, 96, 176, 240)]
    return np.array(grid, np.uint8).reshape(6, 8, 3).repeat(40, axis=0).repeat(40, axis=1)


@pytest.mark.parametrize("name", CODECS)
def test_chart_comes_back_within_two_levels(name):
    chart = colour_chart()
    height, width = chart.shape[:2]
    parameters = CodecParameters(name, width, height, quality=BEST[name])
    decoded = create_decoder(parameters).decode(create_encoder(parameters).encode(chart).data).astype(int)
    patches = (decoded - chart).reshape(6, 40, 8, 40, 3)[:, 8:32, :, 8:32].mean(axis=(1, 3))
    assert np.abs(patches).max() <= 2
    assert np.abs(patches.mean(axis=(0, 1))).max() <= 0.5


def test_ffmpegs_own_conversion_is_biased():
    chart = colour_chart()
    frame = av.VideoFrame.from_ndarray(chart, format="bgr24").reformat(format="yuv420p")
    back = frame.to_ndarray(format="bgr24").astype(int)
    ours = cv2.cvtColor(cv2.cvtColor(chart, cv2.COLOR_BGR2YUV_I420), cv2.COLOR_YUV2BGR_I420).astype(int)
    assert np.abs((back - chart).mean()) > np.abs((ours - chart).mean()) + 0.5


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(("width", "height"), [(127, 96), (128, 95), (127, 95), (33, 71)])
def test_odd_sizes_keep_their_last_row_and_column(name, width, height):
    image = natural_image(height, width)
    image[-3:], image[:, -3:] = (30, 30, 230), (230, 60, 30)
    parameters = CodecParameters(name, width, height, quality=BEST[name])
    decoded = create_decoder(parameters).decode(create_encoder(parameters).encode(image).data)
    assert decoded.shape == image.shape
    # Padding by anything but the last row and column would spoil the chroma of both.
    if height % 2:
        assert np.abs(decoded[-1, :-5].astype(int) - (30, 30, 230)).mean() < 12
    if width % 2:
        assert np.abs(decoded[:-5, -1].astype(int) - (230, 60, 30)).mean() < 12


@pytest.mark.parametrize("name", VIDEOS)
def test_streams_say_that_they_are_limited_range(name):
    packet = create_encoder(CodecParameters(name, 128, 96)).encode(moving_clip(1)[0]).data
    decoder = create_decoder(CodecParameters(name, 128, 96))
    frame = decoder.context.decode(av.Packet(packet))[0]
    assert frame.color_range == 1
    assert frame.colorspace in (5, 6)
    assert frame.format.name == "yuv420p"


@pytest.mark.parametrize("name", ["jpeg", "jpeg-ffmpeg"])
def test_jpegs_are_full_range_and_use_it(name):
    """A reader that took them for limited range would be off by some 16 levels at both ends."""
    ramp = np.repeat(np.linspace(0, 255, 256).astype(np.uint8)[None, :, None], 64, axis=0).repeat(3, axis=2)
    parameters = CodecParameters(name, 256, 64, quality=95)
    data = create_encoder(parameters).encode(ramp).data
    frame = av.CodecContext.create("mjpeg", "r").decode(av.Packet(data))[0]
    luma = frame.to_ndarray()[:64].astype(int)
    assert (luma.min(), luma.max()) == (pytest.approx(0, abs=3), pytest.approx(255, abs=3))
    assert np.abs(create_decoder(parameters).decode(data).astype(int) - ramp).max() <= 6


@pytest.mark.parametrize("name", [name for name in STILLS if name != "webp-lossless"])
def test_still_quality_is_not_ignored(name):
    """FFmpeg's mjpeg gives the same bytes for every ``global_quality``, even with the ``qscale`` flag."""
    image = natural_image(96, 128)
    sizes = [
        len(create_encoder(CodecParameters(name, 128, 96, quality=quality)).encode(image).data)
        for quality in (15, 35, 55, 75, 95)
    ]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == len(sizes)
    encoder = create_encoder(CodecParameters(name, 128, 96, quality=75))
    live = []
    for quality in (15, 35, 55, 75, 95):
        encoder.set_quality(quality)
        live.append(len(encoder.encode(image).data))
    assert live == sizes


REGION_NOW_AND_THEN = """
import sys
import numpy as np
from cable_codecs import CodecParameters, create_decoder, create_encoder

name, pattern = sys.argv[1], sys.argv[2]
height, width = 112, 192
image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
region = np.zeros((height, width), np.bool_)
region[32:64, 32:96] = True
parameters = CodecParameters(name, width, height, quality=30, background_offset=0.1)
with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
    for number in range(12):
        roi = region if pattern[number % len(pattern)] == "r" else None
        packet = encoder.encode(np.roll(image, number, axis=1), roi, keyframe=number == 9)
        assert decoder.decode(packet.data).shape == image.shape
print("done")
"""


@pytest.mark.parametrize("name", ["h264", "hevc", "vp9"])
@pytest.mark.parametrize("pattern", ["-r", "r-", "-rr", "--rrrr"])
def test_regions_may_come_with_some_frames_only(name, pattern):
    """libx265 crashes the process where offsets come with two frames running and not with the first."""
    command = [sys.executable, "-X", "faulthandler", "-c", REGION_NOW_AND_THEN, name, pattern]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr[-2000:]


@pytest.mark.parametrize("name", ["h264", "hevc", "vp9"])
def test_no_region_is_all_of_the_frame(name):
    clip = moving_clip(6)
    parameters = CodecParameters(name, 128, 96, background_offset=0.3)
    without, everything = create_encoder(parameters), create_encoder(parameters)
    for image in clip:
        assert without.encode(image).data == everything.encode(image, np.ones((96, 128), np.bool_)).data
