"""Tileable noise shared by ground, facades, clouds and the sensor."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]


def tileable_noise(rng: np.random.Generator, size: int, exponent: float) -> Float32Array:
    """Noise [size, size] with spectrum 1/f**exponent, periodic, zero mean, unit variance."""
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    radius = np.hypot(fy, fx)
    radius[0, 0] = 1.0
    spectrum /= radius**exponent
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, s=(size, size))
    return np.asarray(field / field.std(), dtype=np.float32)


def sample_wrapped(noise: Float32Array, x: Float32Array, y: Float32Array) -> Float32Array:
    """Periodic bilinear look-up at texel coordinates x, y [H, W], each in 0 .. size."""
    return np.asarray(cv2.remap(noise, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float32)
