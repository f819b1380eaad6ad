"""Treat, code without loss, undo: inside the region the camera's picture comes back bit for bit."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from cable_codecs.base import CodecParameters
from cable_codecs.errors import CodecError
from cable_codecs.region_grid import block_shape, grow_to_grid, region_pixels
from cable_codecs.region_receiver import RegionReceiver
from cable_codecs.region_sender import RegionSender
from cable_codecs.registry import create_encoder
from cable_codecs.sized_codecs import MOST_SIZES, SizedDecoder, SizedEncoder
from cable_codecs.treatment import RegionTreatment
from cable_codecs.upload_scale import enlarge_image, reduce_image
from codec_images import luma_psnr
from hypothesis import given, settings
from hypothesis import strategies as st

FILLS = ("zero", "grey", "mean", "blur", "freeze", "keep")


def possible(**switches):
    try:
        return RegionTreatment(**switches)
    except CodecError:
        return None


EVERY_TREATMENT = [
    treatment
    for fill, grid, hold, feather, crop, scale, compose in itertools.product(
        FILLS, (1, 8, 16), (0, 2), (0, 5), ("none", "rows", "box"), (1.0, 0.5), (False, True)
    )
    if (
        treatment := possible(
            fill=fill, grid=grid, hold_frames=hold, feather_px=feather, crop=crop, scale=scale, compose=compose
        )
    )
]


def lossless(image):
    return cv2.imdecode(cv2.imencode(".png", image)[1], cv2.IMREAD_COLOR)


def a_clip(seed, height, width, block_size, count=6):
    """Pictures with what the tracker wants of them; the first and fifth whole, the fourth nothing."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        image = rng.integers(0, 256, (height, width, 3), np.uint8)
        blocks = rng.random(block_shape(height, width, block_size)) < 0.1
        if number == 3:
            blocks[:] = False
        yield image, None if number in (0, 4) else blocks


@settings(max_examples=250, deadline=None)
@given(
    treatment=st.sampled_from(EVERY_TREATMENT),
    seed=st.integers(0, 1000),
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    block_size=st.sampled_from([1, 4, 8, 12, 16]),
)
def test_round_trip(treatment, seed, height, width, block_size):
    uncropped = RegionSender(replace(treatment, crop="none"), height, width)
    sender, receiver = (side(treatment, height, width) for side in (RegionSender, RegionReceiver))
    for stamp, (image, blocks) in enumerate(a_clip(seed, height, width, block_size)):
        before = image.copy()
        treated = sender.treat(image, blocks, block_size)
        assert np.array_equal(image, before)
        cut = (slice(None), slice(None)) if treated.crop is None else treated.crop.slices
        picture = uncropped.treat(image, blocks, block_size).image.copy()
        assert np.array_equal(treated.image, picture[cut])
        if treatment.fill == "zero":
            picture[cut] = 0
            assert not picture.any()
        decoded = lossless(treated.image)
        assert receiver.crop_of(treated.blocks, treated.block_size) == treated.crop
        restored = receiver.restore(decoded, treated.blocks, treated.block_size, stamp=stamp)
        expected = image
        if treatment.scale < 1:
            small = reduce_image(image, sender.geometry.uploaded)
            expected = enlarge_image(small, (height, width), treatment.interpolation)
        assert restored.image.shape == image.shape
        if blocks is None:
            assert treated.blocks is None
            assert treated.crop is None
            assert treated.encoder_roi() is None
            assert restored.roi is None
            assert np.array_equal(restored.image, expected)
            continue
        region = region_pixels(treated.blocks, treated.block_size, height, width)
        assert np.array_equal(restored.roi, region)
        # What the tracker wants is in, on the grid, and comes back.
        wanted = region_pixels(blocks, block_size, height, width)
        assert not (wanted & ~region).any()
        grown = grow_to_grid(region, 1, treatment.grid, height, width)
        assert np.array_equal(region_pixels(grown, treatment.grid, height, width), region)
        assert np.array_equal(restored.image[region], expected[region])
        assert treated.encoder_roi().shape == treated.image.shape[:2]
        if treatment.compose:
            assert np.array_equal(restored.composed.image, restored.image)
            assert (restored.composed.ages >= 0).all()
        elif treatment.fill in ("zero", "grey"):
            assert (restored.image[~region] == (128 if treatment.fill == "grey" else 0)).all()
        elif treatment.fill == "mean":
            colours = np.unique(restored.image[~region], axis=0)
            assert len(colours) <= 1
            sent = treated.image[~treated.encoder_roi()]
            if len(colours) and len(sent):
                assert np.array_equal(colours[0], np.rint(sent.mean(axis=0)))


def test_the_encoder_is_told_where_the_region_is():
    image = np.random.default_rng(0).integers(1, 256, (75, 101, 3), np.uint8)
    blocks = np.zeros((10, 13), bool)
    blocks[4:6, 7] = True
    for treatment in (t for t in EVERY_TREATMENT if t.fill == "zero" and not t.feather_px):
        treated = RegionSender(treatment, 75, 101).treat(image, blocks, 8)
        assert np.array_equal(treated.encoder_roi(), treated.image.any(axis=2))


def test_frozen_background_trails_until_a_keyframe():
    treatment = RegionTreatment(fill="freeze")
    sender, receiver = RegionSender(treatment, 32, 32), RegionReceiver(treatment, 32, 32)
    first, second, third, fourth = (np.full((32, 32, 3), level, np.uint8) for level in (10, 20, 30, 40))
    left, right = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    left[:, 0], right[:, 3] = True, True

    def shown(image, blocks, keyframe=False):
        treated = sender.treat(image, blocks, 8, keyframe=keyframe)
        restored = receiver.restore(lossless(treated.image), treated.blocks, 8)
        return [[int(picture[0, x, 0]) for x in (0, 15, 31)] for picture in (treated.image, restored.image)]

    # What is coded keeps what was last sent; what the models see is black there, for it is stale.
    assert shown(first, left) == [[10, 0, 0], [10, 0, 0]]
    assert shown(second, right) == [[10, 0, 20], [0, 0, 20]]
    assert shown(third, left, keyframe=True) == [[30, 0, 0], [30, 0, 0]]
    assert shown(fourth, None) == [[40, 40, 40], [40, 40, 40]]
    assert shown(first, right) == [[40, 40, 10], [0, 0, 10]]


def test_hysteresis_forgets_at_a_whole_frame():
    sender = RegionSender(RegionTreatment(hold_frames=5), 16, 16)
    image, all_blocks, none = np.zeros((16, 16, 3), np.uint8), np.ones((2, 2), bool), np.zeros((2, 2), bool)
    sender.treat(image, all_blocks, 8)
    assert sender.treat(image, none, 8).blocks.all()
    sender.treat(image, None)
    assert not sender.treat(image, none, 8).blocks.any()


@pytest.mark.parametrize("crop", ["none", "rows", "box"])
def test_refilling_takes_away_what_lossy_coding_smeared(crop):
    """JPEG rings outside the region; the receiver's picture is black there, and as decoded inside."""
    treatment = RegionTreatment(crop=crop)
    sender, receiver = RegionSender(treatment, 75, 101), RegionReceiver(treatment, 75, 101)
    parameters = CodecParameters("jpeg", 101, 75, quality=75)
    with SizedEncoder(parameters) as encoder, SizedDecoder(parameters) as decoder:
        for image, blocks in smooth_clip():
            treated = sender.treat(image, blocks, 8)
            data = encoder.encode(treated.image, treated.encoder_roi()).data
            decoded = decoder.decode_sized(data, *treated.image.shape[:2])
            restored = receiver.restore(decoded, blocks, 8)
            assert not restored.image[~restored.roi].any()
            place = treated.crop.slices if treated.crop else (slice(None), slice(None))
            roi = treated.encoder_roi()
            assert np.array_equal(restored.image[place][roi], decoded[roi])
            assert luma_psnr(restored.image[restored.roi], image[restored.roi]) > 20


def smooth_clip():
    """Regions of different heights and widths."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (75, 101, 3), np.uint8), (0, 0), 2)
    for top, bottom, left, right in ((3, 6, 2, 9), (0, 2, 0, 13), (8, 10, 11, 13), (3, 6, 2, 9)):
        blocks = np.zeros((10, 13), bool)
        blocks[top:bottom, left:right] = True
        yield image, blocks


@pytest.mark.parametrize("crop", ["rows", "box"])
def test_lossless_crops_come_back(crop):
    treatment = RegionTreatment(crop=crop)
    sender, receiver = RegionSender(treatment, 75, 101), RegionReceiver(treatment, 75, 101)
    parameters = CodecParameters("webp-lossless", 101, 75)
    with SizedEncoder(parameters) as encoder, SizedDecoder(parameters) as decoder:
        for image, blocks in smooth_clip():
            treated = sender.treat(image, blocks, 8)
            box = receiver.crop_of(blocks, 8)
            decoded = decoder.decode_sized(encoder.encode(treated.image).data, box.height, box.width)
            restored = receiver.restore(decoded, blocks, 8)
            assert np.array_equal(restored.image, np.where(restored.roi[..., None], image, 0))


def test_sized_codecs_follow_a_change_of_quality():
    images = [image for image, _ in smooth_clip()][:2]
    parts = [images[0], np.ascontiguousarray(images[0][:32]), np.ascontiguousarray(images[0][:48, :64])]
    with SizedEncoder(CodecParameters("jpeg", 101, 75, quality=90)) as encoder:
        fine = [len(encoder.encode(part).data) for part in parts[:2]]
        encoder.set_quality(20)
        coarse = [encoder.encode(part).data for part in parts]
    for part, data in zip(parts, coarse, strict=True):
        height, width = part.shape[:2]
        with create_encoder(CodecParameters("jpeg", width, height, quality=20)) as literal:
            assert data == literal.encode(part).data
    assert len(coarse[0]) < fine[0]
    assert len(coarse[1]) < fine[1]


def test_sized_codecs_keep_few_sizes_open():
    with SizedEncoder(CodecParameters("jpeg", 8, 100)) as encoder:
        for height in range(1, 101):
            assert encoder.encode(np.zeros((height, 8, 3), np.uint8)).keyframe
        assert len(encoder.encoders) == MOST_SIZES
    with pytest.raises(CodecError, match="closed"):
        encoder.encode(np.zeros((4, 8, 3), np.uint8))


def test_sizes_that_cannot_be_are_named():
    parameters = CodecParameters("jpeg", 64, 48)
    with SizedEncoder(parameters) as encoder, SizedDecoder(parameters) as decoder:
        assert not decoder.needs_keyframe
        data = encoder.encode(np.zeros((16, 64, 3), np.uint8)).data
        with pytest.raises(CodecError, match="up to 64x48"):
            encoder.encode(np.zeros((48, 65, 3), np.uint8))
        with pytest.raises(CodecError, match="up to 64x48"):
            decoder.decode_sized(data, 49, 64)
        with pytest.raises(CodecError):
            decoder.decode_sized(data, 32, 64)
        with pytest.raises(CodecError):
            decoder.decode(data)
        assert decoder.decode_sized(data, 16, 64).shape == (16, 64, 3)
    with pytest.raises(CodecError, match="closed"):
        decoder.decode_sized(data, 16, 64)
    with pytest.raises(CodecError, match=r"h264.*size"):
        SizedEncoder(CodecParameters("h264", 64, 48))


@pytest.mark.parametrize(
    ("switches", "text"),
    [
        ({"fill": "pink"}, "fill"),
        ({"grid": 0}, "grid"),
        ({"grid": 65}, "grid"),
        ({"hold_frames": -1}, "hold"),
        ({"hold_most_share": 0.0}, "share"),
        ({"feather_px": 65}, "feather"),
        ({"feather_px": 3, "fill": "freeze"}, "feather"),
        ({"feather_px": 3, "fill": "keep"}, "feather"),
        ({"crop": "columns"}, "crop"),
        ({"crop": "box", "fill": "freeze"}, "crop"),
        ({"scale": 0.0}, "scale"),
        ({"scale": 2.0}, "scale"),
        ({"interpolation": "sharp"}, "interpolation"),
        ({"quantiser_offset": -0.1}, "offset"),
        ({"quantiser_offset": 1.1}, "offset"),
    ],
)
def test_senseless_treatments_are_named(switches, text):
    with pytest.raises(CodecError, match=text):
        RegionTreatment(**switches)


def test_codecs_that_cannot_carry_a_treatment_are_named():
    RegionTreatment().check_codec("h264", stateless=False)
    RegionTreatment.default_for(stateless=True).check_codec("jpeg", stateless=True)
    with pytest.raises(CodecError, match=r"h264.*size"):
        RegionTreatment.default_for(stateless=True).check_codec("h264", stateless=False)
    with pytest.raises(CodecError, match=r"jpeg.*frame"):
        RegionTreatment(fill="freeze").check_codec("jpeg", stateless=True)
    with pytest.raises(CodecError, match=r"webp.*offset"):
        RegionTreatment(fill="keep", quantiser_offset=0.4).check_codec("webp", stateless=True)


def test_frames_that_do_not_fit_are_named():
    treatment = RegionTreatment(crop="rows")
    sender, receiver = RegionSender(treatment, 64, 48), RegionReceiver(treatment, 64, 48)
    image, blocks = np.zeros((64, 48, 3), np.uint8), np.zeros((8, 6), bool)
    blocks[3] = True
    with pytest.raises(CodecError, match="image"):
        sender.treat(image[:32], blocks, 8)
    with pytest.raises(CodecError, match="blocks of 8"):
        sender.treat(image, blocks[:3], 8)
    treated = sender.treat(image, blocks, 8)
    assert treated.image.shape == (16, 48, 3)
    with pytest.raises(CodecError, match="same treatment"):
        receiver.restore(image, blocks, 8)
    with pytest.raises(CodecError, match="off the treatment's grid"):
        receiver.restore(treated.image, np.zeros((16, 12), bool), 4)
    with pytest.raises(CodecError, match="blocks of 8"):
        receiver.restore(treated.image, blocks[:3], 8)
    with pytest.raises(CodecError, match="positive"):
        RegionSender(treatment, 0, 10)
