"""Test pictures with structure at every scale, so that codecs meet something like a photograph."""

from __future__ import annotations

import cv2
import numpy as np

STILLS = ("jpeg", "jpeg-ffmpeg", "webp", "webp-lossless")
VIDEOS = ("h264", "hevc", "av1", "vp9")
CODECS = STILLS + VIDEOS
LOSSY = tuple(name for name in CODECS if name != "webp-lossless")
BEST = {"jpeg": 100, "jpeg-ffmpeg": 100, "webp": 100, "webp-lossless": None, "h264": 1, "hevc": 1, "av1": 1, "vp9": 1}
HIGH = {"jpeg": 92, "jpeg-ffmpeg": 92, "webp": 92, "webp-lossless": None, "h264": 16, "hevc": 16, "av1": 20, "vp9": 16}


def natural_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Noise whose amplitude falls with frequency, uint8 [height, width, 3]; chroma weaker than luma."""
    rng = np.random.default_rng(seed)
    luma = octaves(rng, height, width)
    image = np.stack([luma + 0.3 * octaves(rng, height, width) for _ in range(3)], axis=2)
    return np.clip(128 + 45 * image, 0, 255).astype(np.uint8)


def octaves(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    total = np.zeros((height, width), np.float32)
    cells, amplitude = 3, 1.0
    while cells < max(height, width):
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        total += amplitude * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, amplitude = cells * 2, amplitude * 0.5
    return total


def moving_clip(count: int, height: int = 96, width: int = 128) -> list[np.ndarray]:
    """A picture shifting by two pixels per frame."""
    image = natural_image(height, width)
    return [np.ascontiguousarray(np.roll(image, 2 * index, axis=1)) for index in range(count)]


def luma_psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Literal PSNR of BT.601 luma in double precision."""
    weights = np.array([0.114, 0.587, 0.299])
    difference = (first.astype(np.float64) - second.astype(np.float64)) @ weights
    error = float(np.mean(difference**2))
    return float("inf") if error == 0 else 10 * np.log10(255**2 / error)
