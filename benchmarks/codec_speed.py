"""Milliseconds and bytes per frame of every codec: ``python benchmarks/codec_speed.py --clip drive.mp4``."""

from __future__ import annotations

import argparse
import statistics
import time
from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
from cable_codecs import CodecParameters, available_codecs, create_decoder, create_encoder, roi_psnr


def read_clip(path: Path, count: int) -> list[np.ndarray]:
    """The first frames of a video, BGR."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="bgr24") for frame in islice(container.decode(video=0), count)]


def synthetic_clip(height: int, width: int, count: int) -> list[np.ndarray]:
    """Smoothed noise shifting by four pixels per frame."""
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 5), None, 0, 255, cv2.NORM_MINMAX)
    return [np.ascontiguousarray(np.roll(texture, 4 * index, axis=1)) for index in range(count)]


def measure(name: str, frames: list[np.ndarray], threads: int) -> str:
    """One line of the table."""
    height, width = frames[0].shape[:2]
    parameters = CodecParameters(name, width, height, threads=threads)
    everywhere = np.ones((height, width), np.bool_)
    encode_ms, decode_ms, sizes, fidelity = [], [], [], []
    with create_encoder(parameters) as encoder, create_decoder(parameters) as decoder:
        for frame in frames:
            encoded = encoder.encode(frame)
            started = time.perf_counter()
            decoded = decoder.decode(encoded.data)
            decode_ms.append((time.perf_counter() - started) * 1e3)
            encode_ms.append(encoded.duration_ns / 1e6)
            sizes.append(len(encoded.data))
            fidelity.append(roi_psnr(frame, decoded, everywhere))
    return (
        f"{name:6} {statistics.median(encode_ms):10.2f} {statistics.median(decode_ms):10.2f} "
        f"{statistics.mean(sizes):12.0f} {statistics.mean(fidelity):8.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clip", type=Path, help="video file; without it a moving texture is used")
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.threads)
    width, height = arguments.size
    frames = (
        read_clip(arguments.clip, arguments.frames)
        if arguments.clip
        else synthetic_clip(height, width, arguments.frames)
    )
    print(f"{len(frames)} frames of {frames[0].shape[1]}x{frames[0].shape[0]}, {arguments.threads} thread(s)")
    print("codec   encode ms  decode ms  bytes/frame  luma dB")
    for name in available_codecs():
        print(measure(name, frames, arguments.threads))


if __name__ == "__main__":
    main()
