"""Bytes and milliseconds of coded masks: ``python benchmarks/mask_codec.py``.

Masks of the loop come from the tracker on a rendered drive, with the truth's mask as the cloud's answer: the region in
blocks, and the answer in pixels. Box masks are the truth's boxes, ragged ones thresholded differences of frames. All
codings are lossless. ``runs, bits`` is the codec without its arithmetically coded form; the general compressors get the
cells, 8 to a byte, or the byte form of the runs along the columns. Times are the best of several on one thread.
"""

from __future__ import annotations

import argparse
import bz2
import lzma
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import decode_mask, encode_mask
from cable_codecs.mask_context import MOST_DECISIONS
from cable_codecs.mask_runs import changes_to_bytes, column_changes
from rich.console import Console
from rich.table import Table

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.types import RoiMask

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
RAGGED_CLIPS = ("urban-540p/traffic.mp4", "highway-720p/project_video_short.mp4")
LZMA_FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 9, "lc": 0, "lp": 0, "pb": 0}]
REPETITIONS = 5


def loop_masks(width: int, height: int, frames: int, seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """(kind, mask) of a drive: what travels up, what travels down, and the boxes."""
    trackers = {8: RoiTracker(block_size=8), 16: RoiTracker(block_size=16)}
    for frame in SyntheticSource(SyntheticConfig(width=width, height=height, frame_count=frames, seed=seed)):
        truth = frame.truth.instance_mask > 0
        for block_size, tracker in trackers.items():
            proposal = tracker.propose(frame)
            answer = truth & proposal.roi.pixels()
            tracker.update(frame.index, answer)
            if not proposal.keyframe:
                yield f"R {block_size} px", proposal.roi.blocks
            if block_size == 8:
                yield "M", answer
        boxes = np.zeros((height, width), np.bool_)
        for left, top, right, bottom in frame.truth.boxes_xyxy.astype(int):
            boxes[top:bottom, left:right] = True
        yield "boxes", boxes


def ragged_masks(path: Path, frames: int) -> Iterator[tuple[str, np.ndarray]]:
    """Thresholded, dilated differences of the frames of a video file, as pixels and as blocks of 8 px."""
    capture = cv2.VideoCapture(str(path))
    grey_before = None
    for _ in range(frames + 1):
        found, image = capture.read()
        if not found:
            return
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if grey_before is not None:
            changed = (cv2.absdiff(grey, grey_before) > 12).astype(np.uint8)
            mask = cv2.dilate(changed, np.ones((9, 9), np.uint8)).astype(np.bool_)
            yield "ragged", mask
            yield "ragged 8 px", RoiMask.from_pixels(mask, 8).blocks
        grey_before = grey


def best_ms(call: Callable[[], object]) -> float:
    """Milliseconds of the fastest of several calls."""
    times = []
    for _ in range(REPETITIONS):
        started = time.perf_counter_ns()
        call()
        times.append((time.perf_counter_ns() - started) / 1e6)
    return min(times)


def measure(mask: np.ndarray) -> dict[str, float]:
    """Everything the tables show of one mask."""
    coded, budget_free, plain = encode_mask(mask), encode_mask(mask, MOST_DECISIONS), encode_mask(mask, 0)
    if not np.array_equal(decode_mask(coded, *mask.shape), mask):
        raise SystemExit("a mask did not come back")
    bits = np.packbits(mask).tobytes()
    turned = changes_to_bytes(*column_changes(np.ascontiguousarray(mask)), mask.shape[1])
    picture = mask.astype(np.uint8) * 255
    return {
        "coded": len(coded),
        "form 6": coded[0] == 6,
        "no budget": len(budget_free),
        "runs, bits": len(plain),
        "PNG": len(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 9])[1]),
        "bits zlib": len(zlib.compress(bits, 9)),
        "runs lzma": len(lzma.compress(turned, format=lzma.FORMAT_RAW, filters=LZMA_FILTERS)),
        "runs bz2": len(bz2.compress(turned)),
        "enc ms": best_ms(lambda: encode_mask(mask)),
        "dec ms": best_ms(lambda: decode_mask(coded, *mask.shape)),
        "plain enc ms": best_ms(lambda: encode_mask(mask, 0)),
        "plain dec ms": best_ms(lambda: decode_mask(plain, *mask.shape)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="960x540,1600x900,3840x1280")
    parser.add_argument("--frames", type=int, default=12, help="frames of each drive and clip (default 12)")
    parser.add_argument("--seed", type=int, default=3)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)

    samples: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    sources = []
    for size in arguments.sizes.split(","):
        width, height = map(int, size.split("x"))
        sources.append((size, loop_masks(width, height, arguments.frames, arguments.seed)))
    clips = [DATA / clip for clip in RAGGED_CLIPS if (DATA / clip).exists()]
    sources += [(clip.parent.name, ragged_masks(clip, arguments.frames)) for clip in clips]
    for name, masks in sources:
        for kind, mask in masks:
            if mask.any() and not mask.all():
                samples[name, kind].append(measure(mask))

    columns = list(next(iter(samples.values()))[0])
    table = Table("source", "mask", "n", *columns, title="mean bytes a mask; form 6: share of masks; ms: best of 5")
    for (name, kind), rows in samples.items():
        means = {column: float(np.mean([row[column] for row in rows])) for column in columns}
        cells = [f"{value:.2f}" if "ms" in key or key == "form 6" else f"{value:.0f}" for key, value in means.items()]
        table.add_row(name, kind, str(len(rows)), *cells)
    Console(width=180).print(table)


if __name__ == "__main__":
    main()
