"""The inputs of CLIP and SAM, bit for bit as the authors' code and transformers' PIL processor make them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cable_models.errors import ModelError
from cable_models.lisa.images import (
    CLIP_MEAN,
    CLIP_STD,
    SAM_MEAN,
    SAM_STD,
    clip_geometry,
    clip_input,
    sam_input,
    sam_size,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PilImage

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden" / "lisa_tiny_a"
FRAMES = [(180, 320), (320, 180), (57, 91), (91, 57), (20, 33), (33, 20), (56, 56), (56, 300), (1, 9), (233, 234)]
"""Landscape, portrait, odd, smaller than CLIP's input, already of its size, a line, nearly square."""


def random_frame(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height * 10_000 + width).integers(0, 256, (height, width, 3), np.uint8)


def transformers_clip(rgb: PilImage.Image, size: int) -> np.ndarray:
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    processor = CLIPImageProcessorPil(size={"shortest_edge": size}, crop_size={"height": size, "width": size})
    return np.asarray(processor(rgb, return_tensors="np")["pixel_values"][0])


def expand_to_square(rgb: np.ndarray) -> PilImage.Image:
    """LLaVA-1.5's padding, with PIL's own paste."""
    frame = PilImage.fromarray(rgb)
    side = max(frame.size)
    square = PilImage.new(
        "RGB", (side, side), (int(CLIP_MEAN[0] * 255), int(CLIP_MEAN[1] * 255), int(CLIP_MEAN[2] * 255))
    )
    square.paste(frame, ((side - frame.width) // 2, (side - frame.height) // 2))
    return square


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    if not GOLDEN.exists():
        pytest.skip("needs the numerical reference lisa_tiny_a in ../shared/golden")
    with np.load(GOLDEN / "inputs.npz") as arrays:
        return dict(arrays)


def test_golden_clip_input_is_bit_exact(golden: dict[str, np.ndarray]) -> None:
    processor = json.loads((GOLDEN / "clip_vision_tower" / "preprocessor_config.json").read_text())
    frame = golden["image_uint8"][..., ::-1]
    geometry = clip_geometry(frame.shape[:2], processor["size"]["shortest_edge"])
    tensor = clip_input(frame, geometry, processor["image_mean"], processor["image_std"])
    assert tensor.dtype == np.float32
    np.testing.assert_array_equal(tensor, golden["images_clip"][0])


def test_golden_sam_input_is_bit_exact(golden: dict[str, np.ndarray]) -> None:
    tensor, size = sam_input(golden["image_uint8"][..., ::-1], golden["images_sam"].shape[-1])
    assert size == tuple(golden["resize_size"])
    assert tensor.dtype == np.float32
    np.testing.assert_array_equal(tensor, golden["images_sam"][0])


@pytest.mark.parametrize("frame", FRAMES)
def test_crop_equals_transformers(frame: tuple[int, int]) -> None:
    bgr = random_frame(*frame)
    tensor = clip_input(bgr, clip_geometry(frame, 56))
    np.testing.assert_array_equal(tensor, transformers_clip(PilImage.fromarray(bgr[..., ::-1].copy()), 56))


@given(st.integers(1, 130), st.integers(1, 130), st.integers(1, 40))
@settings(max_examples=60, deadline=None)
def test_crop_at_any_size_is_pil_bicubic_rows_first(height: int, width: int, size: int) -> None:
    """The passes are given to PIL one by one: for few pixels Pillow 13 turns them round, the authors' didn't."""
    from transformers.image_transforms import get_resize_output_image_size

    bgr = random_frame(height, width)
    tensor = clip_input(bgr, clip_geometry((height, width), size))
    rows, columns = get_resize_output_image_size(bgr, size, default_to_square=False, input_data_format="channels_last")
    rgb, bicubic = PilImage.fromarray(bgr[..., ::-1].copy()), PilImage.Resampling.BICUBIC
    resized = rgb.resize((columns, height), bicubic).resize((columns, rows), bicubic)
    np.testing.assert_array_equal(tensor, transformers_clip(resized, size))


@pytest.mark.parametrize("frame", FRAMES)
def test_pad_equals_llavas_square(frame: tuple[int, int]) -> None:
    bgr = random_frame(*frame)
    tensor = clip_input(bgr, clip_geometry(frame, 56, "pad"))
    np.testing.assert_array_equal(tensor, transformers_clip(expand_to_square(bgr[..., ::-1].copy()), 56))


@pytest.mark.parametrize("frame", FRAMES)
def test_squash_is_pil_bicubic_rows_first(frame: tuple[int, int]) -> None:
    bgr = random_frame(*frame)
    tensor = clip_input(bgr, clip_geometry(frame, 56, "squash"))
    rgb = PilImage.fromarray(bgr[..., ::-1].copy())
    bicubic = PilImage.Resampling.BICUBIC
    squashed = rgb.resize((56, rgb.height), bicubic).resize((56, 56), bicubic)
    np.testing.assert_array_equal(tensor, transformers_clip(squashed, 56))


def test_released_sizes_on_a_wide_frame() -> None:
    bgr = random_frame(900, 1600)
    expected = transformers_clip(PilImage.fromarray(bgr[..., ::-1].copy()), 224)
    np.testing.assert_array_equal(clip_input(bgr, clip_geometry((900, 1600), 224)), expected)


def test_frame_may_be_a_view_and_is_left_alone() -> None:
    whole = random_frame(100, 200)
    view = whole[10:90, 40:190:2]
    before = whole.copy()
    geometry = clip_geometry(view.shape[:2], 28)
    np.testing.assert_array_equal(clip_input(view, geometry), clip_input(view.copy(), geometry))
    np.testing.assert_array_equal(sam_input(view, 64)[0], sam_input(view.copy(), 64)[0])
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize("frame", [(180, 320), (320, 180), (57, 91), (20, 33), (33, 3), (64, 64)])
def test_sam_input_is_pil_bilinear_normalised_then_padded(frame: tuple[int, int]) -> None:
    bgr = random_frame(*frame)
    tensor, (height, width) = sam_input(bgr, 64)
    rgb, bilinear = PilImage.fromarray(bgr[..., ::-1].copy()), PilImage.Resampling.BILINEAR
    resized = rgb.resize((width, frame[0]), bilinear).resize((width, height), bilinear)
    expected = np.zeros((64, 64, 3), np.float32)
    expected[:height, :width] = (np.asarray(resized).astype(np.float32) - np.float32(SAM_MEAN)) / np.float32(SAM_STD)
    np.testing.assert_array_equal(tensor, expected.transpose(2, 0, 1))


@pytest.mark.parametrize(
    ("frame", "size", "expected"),
    [
        ((900, 1600), 1024, (576, 1024)),
        ((1600, 900), 1024, (1024, 576)),
        ((375, 1242), 1024, (309, 1024)),
        ((3, 8), 4, (2, 4)),  # 1.5 rounds up, not to even
        ((5, 8), 4, (3, 4)),
        ((100, 100), 1024, (1024, 1024)),
    ],
)
def test_sam_size_rounds_half_up(frame: tuple[int, int], size: int, expected: tuple[int, int]) -> None:
    assert sam_size(frame, size) == expected


def test_sam_size_equals_transformers() -> None:
    from transformers import SamImageProcessor

    # Sides whose products with the scale never end in .5, where transformers rounds the same way.
    processor = SamImageProcessor()
    for frame in [(900, 1600), (375, 1242), (1080, 1920), (480, 640), (640, 427)]:
        assert sam_size(frame, 1024) == processor._get_preprocess_shape(frame, longest_edge=1024)


def test_wide_frame_seen_by_clip() -> None:
    geometry = clip_geometry((900, 1600), 224)
    np.testing.assert_allclose(geometry.frame_x([0, 224]), [349.749, 1250.251], atol=1e-3)
    np.testing.assert_allclose(geometry.frame_y([0, 224]), [0, 900])
    geometry = clip_geometry((900, 1600), 336)
    np.testing.assert_allclose(geometry.frame_x([0, 336]), [348.4, 1248.9], atol=0.05)
    rows, columns = geometry.patch_edges(14)
    assert rows.shape == columns.shape == (25,)
    np.testing.assert_allclose(np.diff(rows), 37.5)


def test_padded_frame_seen_by_clip() -> None:
    geometry = clip_geometry((900, 1600), 224, "pad")
    np.testing.assert_allclose(geometry.frame_x([0, 112, 224]), [0, 800, 1600])
    np.testing.assert_allclose(geometry.frame_y([0, 112, 224]), [-350, 450, 1250])
    portrait = clip_geometry((1600, 901), 224, "pad")
    np.testing.assert_allclose(portrait.frame_x([0, 224]), [-349, 1251])  # the odd pixel goes right


def test_squashed_frame_seen_by_clip() -> None:
    geometry = clip_geometry((900, 1600), 224, "squash")
    np.testing.assert_allclose(geometry.frame_x([0, 56, 224]), [0, 400, 1600])
    np.testing.assert_allclose(geometry.frame_y([0, 56, 224]), [0, 225, 900])


@pytest.mark.parametrize("fit", ["crop", "pad", "squash"])
def test_geometry_tells_where_a_block_of_the_frame_appears(fit: str) -> None:
    """A white block shows in CLIP's input with its centre of mass where the geometry puts it."""
    frame = np.zeros((180, 320, 3), np.uint8)
    frame[60:100, 130:210] = 255
    geometry = clip_geometry((180, 320), 56, fit)
    tensor = clip_input(frame, geometry, (0, 0, 0), CLIP_STD)[0]
    centres = np.arange(56) + 0.5
    weights = tensor / tensor.sum()
    assert geometry.frame_y(weights.sum(1) @ centres) == pytest.approx(80, abs=0.5)
    assert geometry.frame_x(weights.sum(0) @ centres) == pytest.approx(170, abs=0.5)


@given(st.integers(1, 400), st.integers(1, 400), st.integers(1, 60), st.sampled_from(["crop", "pad", "squash"]))
@settings(max_examples=150, deadline=None)
def test_geometry_is_consistent(height: int, width: int, size: int, fit: str) -> None:
    geometry = clip_geometry((height, width), size, fit)
    top, bottom = geometry.frame_y([0, size])
    left, right = geometry.frame_x([0, size])
    if fit == "crop":
        assert -1e-9 <= top < bottom <= height + 1e-9
        assert -1e-9 <= left < right <= width + 1e-9
    else:
        assert max(top, left) <= 1e-9
        assert bottom >= height - 1e-9
        assert right >= width - 1e-9
    assert min(geometry.resized) >= size


def test_refusals() -> None:
    geometry = clip_geometry((20, 30), 28)
    with pytest.raises(ModelError, match=r"uint8 \[height, width, 3\]"):
        clip_input(np.zeros((20, 30, 3), np.float32), geometry)
    with pytest.raises(ModelError, match="size"):
        clip_input(np.zeros((30, 20, 3), np.uint8), geometry)
    with pytest.raises(ModelError, match=r"uint8 \[height, width, 3\]"):
        sam_input(np.zeros((20, 30), np.uint8), 64)
    with pytest.raises(ModelError, match="fit"):
        clip_geometry((20, 30), 28, "stretch")
    with pytest.raises(ModelError, match="at least one pixel"):
        clip_geometry((0, 30), 28)
    with pytest.raises(ModelError, match="narrow"):
        sam_size((1, 4000), 1024)
    with pytest.raises(ModelError, match="patch"):
        geometry.patch_edges(29)
