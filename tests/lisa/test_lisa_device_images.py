"""Pictures scaled on the model's device against PIL's."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa.device_images import bicubic, bilinear, clip_input_on_device, resize, sam_input_on_device
from cable_models.lisa.images import ClipFit, clip_geometry, clip_input, sam_input
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PilImage


def noise(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31),
    st.tuples(st.integers(1, 90), st.integers(1, 90)),
    st.tuples(st.integers(1, 90), st.integers(1, 90)),
    st.booleans(),
)
def test_resize_is_pil_s(seed: int, size: tuple[int, int], resized: tuple[int, int], cubic: bool) -> None:
    image = noise(seed, *size)
    resample = PilImage.Resampling.BICUBIC if cubic else PilImage.Resampling.BILINEAR
    # Two calls of one pass each: some releases of Pillow turn the passes round.
    narrow = PilImage.fromarray(image).resize((resized[1], size[0]), resample)
    expected = np.asarray(narrow.resize((resized[1], resized[0]), resample))
    found = resize(torch.from_numpy(image).permute(2, 0, 1), resized, bicubic if cubic else bilinear)
    np.testing.assert_array_equal(found.permute(1, 2, 0).numpy(), expected)


@pytest.mark.parametrize("size", [(900, 1600), (375, 1242), (320, 180), (224, 224), (37, 53)])
def test_inputs_are_bit_exact(size: tuple[int, int]) -> None:
    image = noise(1, *size)
    on_device = torch.from_numpy(image)
    expected, expected_hw = sam_input(image, 512)
    found, found_hw = sam_input_on_device(on_device, 512)
    assert found_hw == expected_hw
    assert found.numpy().tobytes() == expected.tobytes()
    for fit in get_args(ClipFit):
        geometry = clip_geometry(size, 224, fit)
        assert clip_input_on_device(on_device, geometry).numpy().tobytes() == clip_input(image, geometry).tobytes(), fit


def test_other_images_are_refused() -> None:
    with pytest.raises(ModelError, match="uint8"):
        sam_input_on_device(torch.zeros(4, 4, 3), 64)
    with pytest.raises(ModelError, match="size"):
        clip_input_on_device(torch.zeros(4, 4, 3, dtype=torch.uint8), clip_geometry((8, 8), 28))
