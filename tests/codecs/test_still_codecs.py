"""What is particular to the image codecs: Huffman tables, effort, losslessness, and files that aren't whole."""

from __future__ import annotations

from contextlib import suppress

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, CodecParameters, create_decoder, create_encoder
from cable_codecs.still_container import check_jpeg, check_lossless_webp
from codec_images import luma_psnr, natural_image
from hypothesis import example, given, settings
from hypothesis import strategies as st

HEIGHT, WIDTH = 96, 128
IMAGE = natural_image(HEIGHT, WIDTH)
ROI = np.zeros((HEIGHT, WIDTH), bool)
ROI[32:64, 40:104] = True
MASKED = np.where(ROI[..., None], IMAGE, 0).astype(np.uint8)


def encode(image, roi=None, name="jpeg", **settings_):
    height, width = image.shape[:2]
    return create_encoder(CodecParameters(name, width, height, **settings_)).encode(image, roi).data


def decode(data, name="jpeg", size=(HEIGHT, WIDTH)):
    return create_decoder(CodecParameters(name, size[1], size[0])).decode(data)


def test_huffman_tables_are_fitted_where_a_region_is_given_or_asked_for():
    plain, masked = encode(MASKED), encode(MASKED, ROI)
    assert len(masked) < len(plain)
    assert np.array_equal(decode(masked), decode(plain))
    assert encode(MASKED, preset="optimised") == masked
    assert encode(MASKED, ROI, preset="fast") == plain
    with pytest.raises(CodecError, match="fast, optimised"):
        encode(IMAGE, preset="slow")


def test_jpeg_is_subsampled_jfif_that_opencv_reads_alike():
    data = encode(IMAGE, quality=90)
    assert data[:4] == b"\xff\xd8\xff\xe0"
    assert data[6:11] == b"JFIF\0"
    # libjpeg smooths chroma as it enlarges it, so only luma can agree.
    by_opencv = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert luma_psnr(decode(data), by_opencv) > 50


def test_both_jpegs_decode_each_other():
    for encoder, decoder in (("jpeg", "jpeg-ffmpeg"), ("jpeg-ffmpeg", "jpeg")):
        data = encode(IMAGE, name=encoder, quality=90)
        assert luma_psnr(IMAGE, decode(data, decoder)) > 35
        assert np.abs(decode(data, decoder).astype(int) - decode(data, encoder)).mean() < 1.5


@pytest.mark.parametrize("name", ["jpeg", "jpeg-ffmpeg", "webp", "webp-lossless"])
def test_every_shorter_file_is_refused(name):
    data = encode(IMAGE, name=name)
    decoder = create_decoder(CodecParameters(name, WIDTH, HEIGHT))
    for length in [*range(40), *range(40, len(data), 37), len(data) - 2, len(data) - 1]:
        with pytest.raises(CodecError):
            decoder.decode(data[:length])
    assert luma_psnr(IMAGE, decoder.decode(data)) > 30


@pytest.mark.parametrize("name", ["jpeg", "jpeg-ffmpeg"])
def test_cut_scan_is_refused_with_and_without_an_end_marker(name):
    data = encode(IMAGE, name=name)
    for length in (len(data) // 2, len(data) * 3 // 4, len(data) * 7 // 8):
        for end in (b"", b"\xff\xd9"):
            with pytest.raises(CodecError):
                decode(data[:length] + end, name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d + d, "joined"),
        (lambda d: d + b"\0", "joined"),
        (lambda d: d.replace(b"\xff\xc0", b"\xff\xc2"), "progressive"),
        (lambda d: d.replace(b"\xff\xc0", b"\xff\xcf"), "arithmetic"),
        (lambda d: d.replace(b"\xff\xc0", b"\xff\xe1"), "cut"),
        (lambda d: d.replace(b"\xff\xda", b"\xff\xe2"), "cut"),
        (lambda d: d[:2] + b"\xff\xe1\xff\xff" + d[2:], "cut"),
        (lambda d: d[:2] + b"\xff\xe1\0\0" + d[2:], "cut"),
    ],
)
def test_structures_that_are_no_whole_baseline_file(change, message):
    with pytest.raises(CodecError, match=message):
        decode(change(encode(IMAGE)))


def test_huge_size_in_the_header_is_refused_before_decoding():
    data = bytearray(encode(IMAGE))
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(CodecError, match="65535x65535"):
        decode(bytes(data))


def test_progressive_and_oriented_files_of_others():
    progressive = cv2.imencode(".jpg", IMAGE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    with pytest.raises(CodecError, match="progressive"):
        decode(progressive)
    data = encode(IMAGE)
    # EXIF, big endian, one entry: orientation 6, "turn by 90 degrees".
    exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    assert np.array_equal(decode(turned), decode(data))


def test_restart_markers_are_fine():
    data = cv2.imencode(".jpg", IMAGE, [cv2.IMWRITE_JPEG_RST_INTERVAL, 4])[1].tobytes()
    assert luma_psnr(IMAGE, decode(data)) > 33


@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=60), head=st.integers(0, 700))
@example(data=b"\xff\xd9", head=623)
def test_container_checks_survive_any_bytes(data, head):
    for check, name in ((check_jpeg, "jpeg"), (check_lossless_webp, "webp-lossless")):
        # A head of a JPEG that ends in its scan is a whole container again once an end marker follows.
        closed = name == "jpeg" and data.endswith(b"\xff\xd9")
        with suppress(CodecError) if closed else pytest.raises(CodecError):
            check(encode(IMAGE, name=name)[:head] + data, (HEIGHT, WIDTH), name)


@pytest.mark.parametrize("size", [(96, 128), (95, 127), (1, 1), (2, 300), (17, 3)])
@pytest.mark.parametrize("preset", [None, "0", "6"])
def test_lossless_webp_returns_every_pixel(size, preset):
    for image in (
        natural_image(*size),
        np.random.default_rng(5).integers(0, 256, (*size, 3), np.uint8),
        np.zeros((*size, 3), np.uint8),
    ):
        data = encode(image, name="webp-lossless", preset=preset)
        assert np.array_equal(decode(data, "webp-lossless", size), image)


def test_lossless_webp_refuses_other_kinds():
    lossy = encode(IMAGE, name="webp")
    see_through = cv2.imencode(".webp", np.dstack([IMAGE, IMAGE[..., 0]]), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    for data in (lossy, see_through):
        with pytest.raises(CodecError, match="pixel format"):
            decode(data, "webp-lossless")
    with pytest.raises(CodecError, match="128x96, expected 64x48"):
        decode(encode(IMAGE, name="webp-lossless"), "webp-lossless", (48, 64))


@pytest.mark.parametrize("name", ["webp", "webp-lossless"])
def test_webp_effort_is_a_parameter(name):
    image = natural_image(240, 320)
    sizes = {preset: len(encode(image, name=name, preset=preset)) for preset in ("0", "2", "6")}
    assert sizes["6"] < sizes["2"] < sizes["0"] or name == "webp-lossless"
    assert sizes["6"] < sizes["0"]
    for preset in ("7", "-1", "fast", ""):
        with pytest.raises(CodecError, match="preset"):
            encode(image, name=name, preset=preset)


@pytest.mark.parametrize("name", ["jpeg", "jpeg-ffmpeg", "webp"])
def test_live_quality_gives_the_bytes_of_a_fresh_encoder(name):
    encoder = create_encoder(CodecParameters(name, WIDTH, HEIGHT, quality=50))
    for quality in (20, 90, 90, 50):
        encoder.set_quality(quality)
        assert encoder.encode(IMAGE).data == encode(IMAGE, name=name, quality=quality)
    for quality in (0, 101):
        with pytest.raises(CodecError, match="quality"):
            encoder.set_quality(quality)
    assert encoder.reopen_count == 0
