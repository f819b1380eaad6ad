"""The camera's own marks: lens blur, vignetting and noise that is new in every frame."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

UInt8Array = npt.NDArray[np.uint8]

BANK_MARGIN = 64


class Sensor:
    """Turns a clean picture into a camera frame."""

    def __init__(self, seed: int, width: int, height: int, noise: float, blur_sigma: float, vignette: float) -> None:
        """Prepare the vignette and a bank of noise.

        Args:
            seed: Makes the noise reproducible.
            width: Image width in pixels.
            height: Image height in pixels.
            noise: Standard deviation at mid grey, grey levels.
            blur_sigma: Lens blur in pixels.
            vignette: Loss of light in the corners, 0..1.
        """
        self.seed, self.noise, self.blur_sigma = seed, noise, blur_sigma
        rng = np.random.default_rng([seed, 77])
        shape = (height + BANK_MARGIN, width + BANK_MARGIN)
        luma = rng.standard_normal(shape, dtype=np.float32)[..., None]
        chroma = rng.standard_normal((*shape, 3), dtype=np.float32)
        chroma = np.asarray(cv2.GaussianBlur(chroma, (0, 0), 0.7), dtype=np.float32)
        self.bank = np.asarray(np.round((luma * 0.85 + chroma * 1.0) * 24.0), dtype=np.int16)
        level = np.arange(256) / 255.0
        # Photon noise grows with the root of the signal; read noise is left in the dark.
        gain = noise * np.sqrt(0.35 + 1.3 * level) * 8.0
        self.gain = np.clip(np.round(gain), 0, 255).astype(np.uint8)
        x = (np.arange(width) - width / 2) / (width / 2)
        y = (np.arange(height) - height / 2) / (height / 2)
        radius = (x[None, :] ** 2 + y[:, None] ** 2) / 2.0
        shade = np.clip(255.0 * (1.0 - vignette * radius**1.3), 0, 255).astype(np.uint8)
        self.shade = cv2.merge([shade, shade, shade])

    def expose(self, image: UInt8Array, index: int) -> UInt8Array:
        """The frame that the sensor delivers, uint8 [H, W, 3] contiguous."""
        if self.blur_sigma > 0:
            # Up to this width the next ring of the kernel weighs less than a grey level.
            side = 3 if self.blur_sigma <= 0.6 else 0
            image = np.asarray(cv2.GaussianBlur(image, (side, side), self.blur_sigma), dtype=np.uint8)
        image = np.asarray(cv2.multiply(image, self.shade, scale=1.0 / 255.0), dtype=np.uint8)
        if self.noise <= 0:
            return np.ascontiguousarray(image)
        rng = np.random.default_rng([self.seed, 5, index])
        y, x = (int(value) for value in rng.integers(0, BANK_MARGIN, 2))
        height, width = image.shape[:2]
        bank = self.bank[y : y + height, x : x + width]
        flips = int(rng.integers(0, 4))
        if flips:
            bank = np.asarray(cv2.flip(bank, flips - 2), dtype=np.int16)
        gain = cv2.LUT(image, self.gain)
        grain = cv2.multiply(bank, gain, scale=1.0 / 192.0, dtype=cv2.CV_16S)
        return np.ascontiguousarray(cv2.add(image, grain, dtype=cv2.CV_8U), dtype=np.uint8)
