"""Time the stages of the region-of-interest tracker on one core: ``python benchmarks/roi_speed.py``."""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.types import CameraIntrinsics, EgoMotion, Frame

SIZES = ((960, 540), (1280, 720), (1600, 900))
STAGES = ("warp", "residual", "dilate", "fuse", "corridor")


def scene(width: int, height: int, count: int, moving: bool) -> list[tuple[Frame, np.ndarray]]:
    """A smooth noisy background with eight road users of mixed size across the frame, and their mask."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (height // 16, width // 8, 3), dtype=np.uint8)
    background = cv2.resize(coarse, (2 * width, height), interpolation=cv2.INTER_CUBIC)
    actors = [
        (float(rng.uniform(0.02, 0.85)), float(rng.uniform(0.45, 0.6)), float(rng.uniform(0.03, 0.14)))
        for _ in range(8)
    ]
    # Sub-pixel lateral drift makes the paper's homography a real warp.
    ego = EgoMotion(12.0, -0.03 if moving else 0.0, 0.02)
    frames = []
    for k in range(count):
        image = background[:, 2 * k : 2 * k + width].copy()
        mask = np.zeros((height, width), np.bool_)
        for x, y, size in actors:
            left, top = int((x + 0.002 * k) * width), int(y * height)
            right, bottom = left + int(size * width), top + int(0.8 * size * width)
            image[top:bottom, left:right] = 40
            mask[top:bottom, left:right] = True
        noise = rng.integers(0, 8, image.shape, dtype=np.uint8)
        camera = CameraIntrinsics(0.8 * width, 0.8 * width, width / 2, height / 2)
        frames.append((Frame(cv2.add(image, noise), k, k * 100_000_000, ego, camera), mask))
    return frames


def profile(width: int, height: int, count: int, moving: bool) -> None:
    """Print the median milliseconds of each stage, of all of ``propose``, and of ``update``."""
    tracker = RoiTracker()
    stages: dict[str, list[float]] = {stage: [] for stage in STAGES}
    proposing, updating, coverage, radius = [], [], [], []
    for frame, mask in scene(width, height, count, moving):
        started = time.perf_counter_ns()
        proposal = tracker.propose(frame)
        proposed = time.perf_counter_ns()
        tracker.update(frame.index, mask)
        updated = time.perf_counter_ns()
        if proposal.prior_index is None:
            continue
        for stage in STAGES:
            stages[stage].append(proposal.timings.stages_ns[stage] / 1e6)
        proposing.append((proposed - started) / 1e6)
        updating.append((updated - proposed) / 1e6)
        coverage.append(proposal.coverage)
        radius.append(proposal.dilation_px)
    columns = " ".join(f"{np.median(stages[stage]):8.2f}" for stage in STAGES)
    print(
        f"{width:>4}x{height:<4} {'shift' if moving else 'still':5} {columns} {np.median(proposing):8.2f} "
        f"{np.percentile(proposing, 95):8.2f} {np.median(updating):8.2f} {np.mean(coverage):8.3f} "
        f"{np.mean(radius):8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    count = parser.parse_args().frames
    cv2.setNumThreads(1)
    print("median ms, one core; total is propose() as a whole")
    heads = [*STAGES, "total", "p95", "update", "coverage", "b_k px"]
    print(f"{'size':>9} {'ego':5} " + " ".join(f"{head:>8}" for head in heads))
    for width, height in SIZES:
        for moving in (False, True):
            profile(width, height, count, moving)


if __name__ == "__main__":
    main()
