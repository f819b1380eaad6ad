"""Quality measures against their definitions and against scikit-image."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from cable_codecs import CodecError, roi_psnr, roi_ssim
from codec_images import natural_image
from scipy import ndimage
from skimage.metrics import structural_similarity


def pair(height=90, width=120):
    reference = natural_image(height, width)
    noise = np.random.default_rng(1).normal(0, 6, reference.shape)
    return reference, np.clip(reference + noise, 0, 255).astype(np.uint8)


def regions(height=90, width=120):
    boxes = np.zeros((height, width), bool)
    boxes[10:50, 20:70] = boxes[60:, 90:] = True
    inner = np.zeros((height, width), bool)
    inner[30:45, 40:60] = True
    return {"all": np.ones((height, width), bool), "boxes": boxes, "inner": inner}


@pytest.mark.parametrize("kind", ["all", "boxes"])
def test_psnr_is_the_definition(kind):
    (reference, test), roi = pair(), regions()[kind]
    first = cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY).astype(np.float64)
    second = cv2.cvtColor(test, cv2.COLOR_BGR2GRAY).astype(np.float64)
    expected = 10 * math.log10(255**2 / np.mean((first - second)[roi] ** 2))
    assert roi_psnr(reference, test, roi) == pytest.approx(expected, abs=1e-6)


def test_psnr_of_known_cases():
    black, white = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)
    everywhere = np.ones((8, 8), bool)
    assert roi_psnr(black, white, everywhere) == pytest.approx(0)
    assert roi_psnr(black, black, everywhere) == math.inf
    assert roi_psnr(black, black + 5, everywhere) == pytest.approx(20 * math.log10(255 / 5))


def test_only_the_region_counts():
    reference, _ = pair()
    roi = regions()["boxes"]
    changed = reference.copy()
    changed[~roi] = 0
    assert roi_psnr(reference, changed, roi) == math.inf
    assert roi_ssim(reference, reference, roi) == pytest.approx(1)


@pytest.mark.parametrize("kind", ["all", "boxes", "inner"])
def test_ssim_agrees_with_scikit_image(kind):
    (reference, test), roi = pair(), regions()[kind]
    _, similarity = structural_similarity(
        cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY),
        cv2.cvtColor(test, cv2.COLOR_BGR2GRAY),
        data_range=255,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    inside = ndimage.binary_erosion(roi, np.ones((7, 7), bool), border_value=0)
    assert roi_ssim(reference, test, roi) == pytest.approx(similarity[inside].mean(), abs=2e-4)


def test_ssim_of_flat_images():
    low, high = np.full((20, 20, 3), 50, np.uint8), np.full((20, 20, 3), 100, np.uint8)
    c1 = (0.01 * 255) ** 2
    expected = (2 * 50 * 100 + c1) / (50**2 + 100**2 + c1)
    assert roi_ssim(low, high, np.ones((20, 20), bool)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("measure", [roi_psnr, roi_ssim])
def test_wrong_arguments_are_named(measure):
    image, roi = natural_image(20, 30), np.ones((20, 30), bool)
    with pytest.raises(CodecError, match="empty"):
        measure(image, image, np.zeros((20, 30), bool))
    with pytest.raises(CodecError, match="size"):
        measure(image, image[:10], roi)
    with pytest.raises(CodecError, match="region"):
        measure(image, image, roi[:10])
    with pytest.raises(CodecError, match="test image"):
        measure(image, image.astype(np.float32), roi)


def test_region_thinner_than_its_rim():
    image, roi = natural_image(20, 30), np.zeros((20, 30), bool)
    roi[5:11, 5:11] = True
    with pytest.raises(CodecError, match="rim"):
        roi_ssim(image, image, roi)
