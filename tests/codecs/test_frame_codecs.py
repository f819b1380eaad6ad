"""Every codec keeps the contract: one packet per frame, same size back, the same bits in every decoder."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import av
import numpy as np
import pytest
from cable_codecs import (
    CodecError,
    CodecParameters,
    CodecUnavailableError,
    available_codecs,
    create_decoder,
    create_encoder,
    registry,
)
from cable_codecs.still import jpeg_quantiser_scale
from codec_images import CODECS, HIGH, LOSSY, STILLS, VIDEOS, luma_psnr, moving_clip, natural_image
from hypothesis import given, settings
from hypothesis import strategies as st

CLIP = Path(__file__).resolve().parents[3] / "shared" / "data" / "highway-540p" / "solidWhiteRight.mp4"


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(("width", "height"), [(1600, 900), (1242, 375), (1225, 370), (641, 479), (98, 50)])
def test_round_trip_keeps_size_and_luma(name, width, height):
    image = natural_image(height, width)
    parameters = CodecParameters(name, width, height)
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        encoded = encoder.encode(image)
        decoded = decoder.decode(encoded.data)
    assert decoded.shape == image.shape
    assert decoded.dtype == np.uint8
    assert encoded.keyframe
    assert encoded.duration_ns > 0
    assert luma_psnr(image, decoded) > 30


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=25, deadline=None)
@given(width=st.integers(16, 70), height=st.integers(16, 70), seed=st.integers(0, 9))
def test_round_trip_of_any_small_size(name, width, height, seed):
    clip = [natural_image(height, width, seed), natural_image(height, width, seed + 1)]
    parameters = CodecParameters(name, width, height, quality=HIGH[name])
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        for image in clip:
            decoded = decoder.decode(encoder.encode(image).data)
            assert decoded.shape == image.shape
            assert luma_psnr(image, decoded) > 28


@pytest.mark.parametrize(
    ("name", "quality"),
    [(name, quality) for name in ("jpeg", "jpeg-ffmpeg", "webp") for quality in (1, 100)]
    + [("h264", 0), ("h264", 51), ("hevc", 0), ("hevc", 51), ("av1", 1), ("av1", 63), ("vp9", 0), ("vp9", 63)],
)
def test_extreme_qualities(name, quality):
    image = natural_image(95, 127)
    parameters = CodecParameters(name, 127, 95, quality=quality)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    expected = 40 if quality in (0, 100) or (name, quality) == ("av1", 1) else 15
    assert luma_psnr(image, decoder.decode(encoder.encode(image).data)) > expected


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 2), (3, 3)])
def test_tiny_sizes_work_or_say_why_not(name, size):
    parameters = CodecParameters(name, width=size[0], height=size[1])
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    try:
        decoded = create_decoder(parameters).decode(create_encoder(parameters).encode(image).data)
    except CodecError:
        return
    assert np.abs(decoded.astype(int) - 90).max() <= 6


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("threads", [1, 3])
def test_one_packet_per_frame_and_equal_pictures_in_two_decoders(name, threads):
    clip = moving_clip(60)
    parameters = CodecParameters(name, 128, 96, threads=threads)
    encoder, edge, cloud = create_encoder(parameters), create_decoder(parameters), create_decoder(parameters)
    for image in clip:
        encoded = encoder.encode(image)
        at_edge, in_cloud = edge.decode(encoded.data), cloud.decode(encoded.data)
        assert np.array_equal(at_edge, in_cloud)
        assert luma_psnr(image, at_edge) > 30
        assert not edge.needs_keyframe


@pytest.mark.parametrize("name", CODECS)
def test_decoded_frames_do_not_change_later(name):
    parameters = CodecParameters(name, 128, 96)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    clip = moving_clip(4)
    first = decoder.decode(encoder.encode(clip[0]).data)
    kept = first.copy()
    for image in clip[1:]:
        decoder.decode(encoder.encode(image).data)
    assert np.array_equal(first, kept)


@pytest.mark.parametrize("name", CODECS)
def test_packets_do_not_depend_on_reused_buffers(name):
    clip = moving_clip(5)
    parameters = CodecParameters(name, 128, 96)
    encoder = create_encoder(parameters)
    reused = [encoder.encode(image).data for image in clip]
    fresh = create_encoder(parameters)
    buffer = np.empty_like(clip[0])
    for image, expected in zip(clip, reused, strict=True):
        buffer[:] = image
        assert fresh.encode(buffer).data == expected
        buffer[:] = 0


@pytest.mark.parametrize("name", STILLS)
def test_still_codecs_are_stateless(name):
    clip = moving_clip(3)
    parameters = CodecParameters(name, 128, 96)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    packets = [encoder.encode(image) for image in clip]
    assert all(packet.keyframe for packet in packets)
    assert create_encoder(parameters).encode(clip[2]).data == packets[2].data
    backwards = [decoder.decode(packet.data) for packet in reversed(packets)]
    for image, decoded in zip(reversed(clip), backwards, strict=True):
        assert luma_psnr(image, decoded) > 30
    assert not decoder.needs_keyframe


@pytest.mark.parametrize("name", LOSSY)
def test_quality_orders_bytes_and_fidelity(name):
    image = natural_image(120, 160)
    levels = (45, 35, 25, 10) if name in VIDEOS else (10, 40, 75, 95)
    sizes, fidelities = [], []
    for quality in levels:
        parameters = CodecParameters(name, 160, 120, quality=quality)
        data = create_encoder(parameters).encode(image).data
        sizes.append(len(data))
        fidelities.append(luma_psnr(image, create_decoder(parameters).decode(data)))
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == len(sizes)
    assert fidelities == sorted(fidelities)


def read_clip(count):
    with av.open(str(CLIP)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in islice(container.decode(video=0), count)]


@pytest.mark.skipif(not CLIP.is_file(), reason=f"the clip {CLIP.name} isn't in ../shared/data")
@pytest.mark.parametrize("quality", [20, 35, 50, 75, 90])
def test_ffmpegs_jpeg_quality_gives_about_the_bytes_of_libjpeg(quality):
    image = read_clip(1)[0]
    height, width = image.shape[:2]
    sizes = [
        len(create_encoder(CodecParameters(name, width, height, quality=quality)).encode(image).data)
        for name in ("jpeg-ffmpeg", "jpeg")
    ]
    assert 0.7 < sizes[0] / sizes[1] < 1.4


def test_jpeg_scale_falls_with_quality_over_the_whole_range():
    scales = [jpeg_quantiser_scale(quality) for quality in range(1, 101)]
    assert scales == sorted(scales, reverse=True)
    assert (scales[0], scales[74], scales[99]) == (31, 4, 1)


@pytest.mark.parametrize("name", CODECS)
def test_region_is_accepted_and_checked(name):
    image = natural_image(48, 64)
    encoder = create_encoder(CodecParameters(name, 64, 48))
    plain = create_encoder(CodecParameters(name, 64, 48)).encode(image)
    if name != "jpeg":
        assert encoder.encode(image, np.zeros((48, 64), bool)).data == plain.data
    with pytest.raises(CodecError, match="region"):
        encoder.encode(image, np.zeros((6, 8), bool))


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((48, 65, 3), np.uint8),
        np.zeros((48, 64), np.uint8),
        np.zeros((48, 64, 4), np.uint8),
        np.zeros((48, 64, 3), np.float32),
    ],
)
def test_wrong_image_is_refused_and_the_encoder_lives(name, image):
    encoder = create_encoder(CodecParameters(name, 64, 48))
    with pytest.raises(CodecError, match="64, 3"):
        encoder.encode(image)
    assert encoder.encode(natural_image(48, 64)).keyframe


@pytest.mark.parametrize("name", CODECS)
def test_image_views_with_strides_are_encoded_rightly(name):
    image = natural_image(48, 64)
    mirrored = image[:, ::-1]
    parameters = CodecParameters(name, 64, 48)
    expected = create_encoder(parameters).encode(np.ascontiguousarray(mirrored)).data
    assert create_encoder(parameters).encode(mirrored).data == expected


@pytest.mark.parametrize("name", CODECS)
def test_closed_codecs_say_so(name):
    parameters = CodecParameters(name, 64, 48)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    data = encoder.encode(natural_image(48, 64)).data
    encoder.close()
    decoder.close()
    with pytest.raises(CodecError, match="closed"):
        encoder.encode(natural_image(48, 64))
    with pytest.raises(CodecError, match="closed"):
        decoder.decode(data)


@pytest.mark.parametrize(
    "settings_",
    [
        {"width": 0},
        {"height": 16385},
        {"frame_rate": 0.0},
        {"frame_rate": float("nan")},
        {"keyframe_interval": 0},
        {"threads": 0},
    ],
)
def test_parameters_out_of_range_are_refused(settings_):
    with pytest.raises(CodecError, match=next(iter(settings_))):
        CodecParameters(**{"name": "jpeg", "width": 64, "height": 48, **settings_})


BAD_QUALITIES = [("jpeg", 0), ("jpeg", 101), ("jpeg-ffmpeg", 0), ("webp", 0), ("webp-lossless", 50)]
BAD_QUALITIES += [("h264", 52), ("h264", -1), ("hevc", 52), ("av1", 0), ("av1", 64), ("vp9", 64)]


@pytest.mark.parametrize(("name", "quality"), BAD_QUALITIES)
def test_quality_out_of_range_is_refused(name, quality):
    with pytest.raises(CodecError, match="quality"):
        create_encoder(CodecParameters(name, 64, 48, quality=quality))


def test_unknown_codec_lists_the_available_ones():
    with pytest.raises(CodecUnavailableError, match=r"'jpeg2000'.*jpeg, .*webp, .*h264") as caught:
        create_encoder(CodecParameters("jpeg2000", 64, 48))
    assert caught.value.name == "jpeg2000"
    assert caught.value.available == available_codecs() == CODECS


def test_codec_missing_from_the_library_is_named(monkeypatch):
    def refuse(parameters):
        raise CodecError("libx264 can't be opened")

    monkeypatch.setitem(registry.CODECS, "h264", registry.CodecEntry(refuse, refuse))
    registry.unavailability.cache_clear()
    try:
        assert available_codecs() == tuple(name for name in CODECS if name != "h264")
        with pytest.raises(CodecUnavailableError, match="libx264 can't be opened"):
            create_decoder(CodecParameters("h264", 64, 48))
    finally:
        registry.unavailability.cache_clear()


@pytest.mark.skipif(not CLIP.is_file(), reason=f"the clip {CLIP.name} isn't in ../shared/data")
@pytest.mark.parametrize("name", CODECS)
def test_real_video(name):
    frames = read_clip(5)
    height, width = frames[0].shape[:2]
    parameters = CodecParameters(name, width, height, frame_rate=25)
    encoder, decoder = create_encoder(parameters), create_decoder(parameters)
    packets = [encoder.encode(frame) for frame in frames]
    assert [packet.keyframe for packet in packets] == [True] + [name in STILLS] * 4
    for frame, packet in zip(frames, packets, strict=True):
        assert luma_psnr(frame, decoder.decode(packet.data)) > 33
