"""Whatever bytes arrive, a decoder returns a picture of its size or raises CodecError, and works on."""

from __future__ import annotations

import contextlib
import random

import av
import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from codec_images import CODECS, STILLS, VIDEOS, luma_psnr, moving_clip, natural_image
from hypothesis import given, settings
from hypothesis import strategies as st

IMAGE = natural_image(48, 64)
PACKETS = {name: create_encoder(CodecParameters(name, 64, 48)).encode(IMAGE).data for name in CODECS}


def decode_or_refuse(decoder, data):
    try:
        picture = decoder.decode(data)
    except CodecError:
        return
    assert picture.shape == (48, 64, 3)


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_flipped_and_cut_packets(name, data):
    packet = bytearray(PACKETS[name])
    for position in data.draw(st.lists(st.integers(0, len(packet) - 1), max_size=8)):
        packet[position] ^= data.draw(st.integers(1, 255))
    decoder = create_decoder(CodecParameters(name, 64, 48))
    decode_or_refuse(decoder, bytes(packet[: data.draw(st.integers(0, len(packet)))]))
    assert luma_psnr(IMAGE, decoder.decode(PACKETS[name])) > 30


@pytest.mark.parametrize("name", CODECS)
@settings(max_examples=40, deadline=None)
@given(garbage=st.binary(max_size=300), head=st.integers(0, 40))
def test_garbage(name, garbage, head):
    decoder = create_decoder(CodecParameters(name, 64, 48))
    decode_or_refuse(decoder, PACKETS[name][:head] + garbage)
    assert luma_psnr(IMAGE, decoder.decode(PACKETS[name])) > 30


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("other", CODECS)
def test_packets_of_another_codec(name, other):
    if name.split("-ffmpeg")[0] == other.split("-ffmpeg")[0]:
        return
    with pytest.raises(CodecError):
        create_decoder(CodecParameters(name, 64, 48)).decode(PACKETS[other])


@pytest.mark.parametrize("name", VIDEOS)
def test_junk_behind_a_picture_does_not_reach_the_next_keyframe(name):
    parameters = CodecParameters(name, 96, 80)
    encoder = create_encoder(parameters)
    first, second, victim, *rest = [
        encoder.encode(image, keyframe=index == 3).data for index, image in enumerate(moving_clip(5, 80, 96))
    ]
    fresh = create_decoder(parameters)
    expected = [fresh.decode(packet) for packet in rest]
    rng = random.Random(5)
    for number in range(60):
        decoder = create_decoder(parameters)
        decoder.decode(first)
        decoder.decode(second)
        whole = victim if number % 2 else victim[:-1]
        refused = False
        try:
            decoder.decode(whole + rng.randbytes(rng.choice((2, 5, 50, 300))))
        except CodecError:
            refused = True
        # OBUs state their sizes; in the other codecs a picture may be followed by anything.
        assert refused or name != "av1"
        assert decoder.needs_keyframe == refused
        for packet, picture in zip(rest, expected, strict=True):
            assert np.array_equal(decoder.decode(packet), picture)


@pytest.mark.parametrize("name", VIDEOS)
def test_what_a_context_still_holds_does_not_reach_the_next_keyframe(name):
    """As above, past our own checks of the packet: dav1d keeps junk and refuses the keyframe for it."""
    parameters = CodecParameters(name, 96, 80)
    encoder = create_encoder(parameters)
    packets = [encoder.encode(image, keyframe=index == 2).data for index, image in enumerate(moving_clip(3, 80, 96))]
    picture = create_decoder(parameters).decode(packets[2])
    rng = random.Random(5)
    for _ in range(30):
        decoder = create_decoder(parameters)
        decoder.decode(packets[0])
        with contextlib.suppress(av.FFmpegError):
            decoder.context.decode(av.Packet(packets[1] + rng.randbytes(300)))
        assert np.array_equal(decoder.decode(packets[2]), picture)


@pytest.mark.parametrize("name", STILLS)
@pytest.mark.parametrize("change", [lambda b: b"", lambda b: b[:-1], lambda b: b[: len(b) // 2], lambda b: b + b])
def test_still_images_must_be_whole(name, change):
    with pytest.raises(CodecError, match=r"cut|joined"):
        create_decoder(CodecParameters(name, 64, 48)).decode(change(PACKETS[name]))


@pytest.mark.parametrize("name", STILLS)
@pytest.mark.parametrize(("width", "height"), [(66, 48), (64, 47), (16, 16), (1500, 1000)])
def test_still_images_of_another_size(name, width, height):
    data = create_encoder(CodecParameters(name, width, height)).encode(natural_image(height, width)).data
    with pytest.raises(CodecError):
        create_decoder(CodecParameters(name, 64, 48)).decode(data)


def test_other_kinds_of_the_same_format_are_refused():
    grey = cv2.imencode(".jpg", IMAGE[..., 0])[1].tobytes()
    full_chroma = cv2.imencode(".jpg", IMAGE, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])[
        1
    ].tobytes()
    lossless = cv2.imencode(".webp", IMAGE, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    with_alpha = cv2.imencode(".webp", np.dstack([IMAGE, IMAGE[..., 0]]), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
    for name, data in (("jpeg", grey), ("jpeg", full_chroma), ("webp", lossless), ("webp", with_alpha)):
        with pytest.raises(CodecError, match="pixel format"):
            create_decoder(CodecParameters(name, 64, 48)).decode(data)


@pytest.mark.parametrize(("name", "suffix"), [("jpeg", ".jpg"), ("webp", ".webp")])
def test_files_of_other_encoders_decode(name, suffix):
    data = cv2.imencode(suffix, IMAGE, [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_WEBP_QUALITY, 90])[1].tobytes()
    assert luma_psnr(IMAGE, create_decoder(CodecParameters(name, 64, 48)).decode(data)) > 33


def marker_positions(data: bytes) -> dict[int, int]:
    """Where each kind of segment of a JPEG stands last, up to the scan."""
    positions, position = {}, 2
    while 0xDA not in positions:
        positions[data[position + 1]] = position
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return positions


@pytest.mark.parametrize("marker", [0xDB, 0xC4, 0xC0, 0xDA])
def test_jpeg_without_a_segment_it_needs_is_refused(marker):
    data = PACKETS["jpeg"]
    start = marker_positions(data)[marker]
    length = 2 + int.from_bytes(data[start + 2 : start + 4], "big")
    with pytest.raises(CodecError):
        create_decoder(CodecParameters("jpeg", 64, 48)).decode(data[:start] + data[start + length :])


@pytest.mark.parametrize("comment", [b"CS=ITU601", b"Intel(R) JPEG Library, version 1"])
def test_jpeg_comments_leave_nothing_behind(comment):
    """FFmpeg takes one for a limited range, the other for a picture upside down, in the images that follow as well."""
    data = PACKETS["jpeg"]
    scan = marker_positions(data)[0xDA]
    decoder = create_decoder(CodecParameters("jpeg", 64, 48))
    picture = decoder.decode(data)
    decode_or_refuse(decoder, data[:scan] + b"\xff\xfe" + (len(comment) + 2).to_bytes(2, "big") + comment + data[scan:])
    assert np.array_equal(decoder.decode(data), picture)


@pytest.mark.parametrize("name", CODECS)
def test_damaged_packets_write_nothing_to_standard_error(name, capfd):
    """OpenCV's libjpeg writes a line about each damaged image past Python, enough to fill a server's log."""
    decoder = create_decoder(CodecParameters(name, 64, 48))
    rng = random.Random(1)
    for _ in range(60):
        packet = bytearray(PACKETS[name])
        for _ in range(3):
            packet[rng.randrange(len(packet) // 2, len(packet) - 2)] = rng.randrange(256)
        decode_or_refuse(decoder, bytes(packet))
    assert capfd.readouterr() == ("", "")
