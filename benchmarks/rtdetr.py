"""RT-DETR through ONNX Runtime against torch, on the CPU: ``python benchmarks/rtdetr.py``.

Random weights in the published shapes (r18, r50; 640x640), exported by the code behind `cable-rpc export rtdetr`. All
that is compared runs in one process, interleaved round by round, on the same images. Times are CPU times of the process
(user and system, all threads) and wall times; the ratio, not the milliseconds, carries over to another machine. The
effect of cutting to the region is measured with the embedded detector, whose weights are trained, on rendered frames.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from cable_models import embedded_detector_path
from cable_models.detection import DetectedBoxes
from cable_models.rtdetr import CropConfig, DetectorSettings, OnnxDetector, SessionSettings
from cable_models.rtdetr.checkpoints import Checkpoint
from cable_models.rtdetr.crop import crop_window
from cable_models.rtdetr.detector_file import simplified
from cable_models.rtdetr.export import export_checkpoint
from cable_models.rtdetr.labels import COCO80_NAMES
from cable_models.rtdetr.postprocess import decode_logits
from cable_models.rtdetr.precision import to_fp16, to_int8
from cable_models.rtdetr.preprocess import InputRecipe, fill_input
from cable_models.training.average_precision import Truth, class_figures
from rich.console import Console
from rich.table import Table
from torch import nn
from transformers import RTDetrConfig, RTDetrForObjectDetection, RTDetrResNetConfig

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.edge.roi_tracker import RoiTracker
from cable_rpc.types import Frame, RoiMask

SIZE_WH = (640, 640)
RUNS = ((1, 1), (1, 2), (1, 3), (2, 1), (2, 3))
"""Threads and batch."""
CROP_SEEDS = range(91_200, 91_208)
CLASSES = (0, 1, 2, 5, 7)
SEEN_HEIGHT, SEEN_SHARE = 12, 0.25
HEIGHTS = ((0.0, np.inf), (0.0, 32.0), (32.0, np.inf))


@dataclass
class Timing:
    """Seconds of one contender, one entry a round."""

    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)

    def run(self, call: Callable[[], object]) -> None:
        """Time one call."""
        cpu, wall = time.process_time(), time.perf_counter()
        call()
        self.cpu_s.append(time.process_time() - cpu)
        self.wall_s.append(time.perf_counter() - wall)


def interleaved(contenders: dict[str, Callable[[], object]], rounds: int) -> dict[str, Timing]:
    """Every contender once a round, after one round to warm up."""
    timings = {name: Timing() for name in contenders}
    for call in contenders.values():
        call()
    for _ in range(rounds):
        for name, call in contenders.items():
            timings[name].run(call)
    return timings


def random_network(name: str) -> RTDetrForObjectDetection:
    """The published shape with random weights that let a signal through."""
    torch.manual_seed(0)
    labels = {"id2label": dict(enumerate(COCO80_NAMES))}
    if name == "r50":
        config = RTDetrConfig(**labels)
    else:
        backbone = RTDetrResNetConfig(
            embedding_size=64, hidden_sizes=[64, 128, 256, 512], depths=[2, 2, 2, 2], layer_type="basic",
            out_indices=[2, 3, 4],
        )  # fmt: skip
        config = RTDetrConfig(
            backbone_config=backbone, encoder_in_channels=[128, 256, 512], hidden_expansion=0.5, decoder_layers=3,
            **labels,
        )  # fmt: skip
    model = RTDetrForObjectDetection(config).train(False)
    for module in model.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.ones_(module.weight)
    return model


def frames_of(seed: int, count: int, stride: int) -> list[Frame]:
    """Rendered frames of 960x540."""
    source = SyntheticSource(SyntheticConfig(seed=seed, width=960, height=540, frame_count=count * stride))
    return [source.frame(index * stride) for index in range(count)]


def compare_network(
    name: str,
    folder: Path,
    rounds: int,
    images: list[np.ndarray],
    console: Console,
    runs: Sequence[tuple[int, int]] = RUNS,
) -> None:
    """Torch, and ONNX Runtime in three precisions for single images, by threads and batch."""
    model = random_network(name)
    checkpoint = Checkpoint(model, dict(enumerate(COCO80_NAMES)), InputRecipe(SIZE_WH), {})
    files = {"fp32": folder / f"{name}.onnx", "fp16": folder / f"{name}_16.onnx", "int8": folder / f"{name}_8.onnx"}
    export_checkpoint(simplified(checkpoint), files["fp32"])
    to_fp16(files["fp32"], files["fp16"])
    to_int8(files["fp32"], files["int8"], [images[index % len(images)] for index in range(8)])
    table = Table(
        "threads", "batch", "contender", "CPU ms/image", "ratio", "wall ms/image", "ratio", title=f"{name} 640x640"
    )
    for threads, batch in runs:
        torch.set_num_threads(threads)
        tensor = np.empty((batch, 3, *SIZE_WH[::-1]), np.float32)
        fill_input([images[index % len(images)] for index in range(batch)], tensor)
        contenders: dict[str, Callable[[], object]] = {"torch eager": lambda t=tensor: torch_run(model, t)}
        kinds = files if batch == 1 else {"fp32": files["fp32"]}
        for kind, path in kinds.items():
            runner = OnnxDetector(path, SessionSettings("cpu", threads)).runner
            contenders[f"onnx {kind}"] = lambda r=runner, t=tensor: r.run(("logits", "pred_boxes"), {"pixel_values": t})
        timings = interleaved(contenders, rounds)
        base = timings["torch eager"]
        for kind, timing in timings.items():
            cpu, wall = float(np.median(timing.cpu_s)), float(np.median(timing.wall_s))
            table.add_row(
                str(threads), str(batch), kind, f"{1e3 * cpu / batch:.0f}", f"{cpu / np.median(base.cpu_s):.2f}",
                f"{1e3 * wall / batch:.0f}", f"{wall / np.median(base.wall_s):.2f}",
            )  # fmt: skip
    console.print(table)
    sizes = ", ".join(f"{kind} {path.stat().st_size / 1e6:.1f} MB" for kind, path in files.items())
    console.print(f"files: {sizes}\n")


def torch_run(model: nn.Module, tensor: np.ndarray) -> object:
    """One inference of torch."""
    with torch.inference_mode():
        return model(pixel_values=torch.from_numpy(tensor))


def compare_edges(rounds: int, console: Console) -> None:
    """What stands before and after the network."""
    rng = np.random.default_rng(0)
    table = Table("image", "step", "CPU ms", title="around the network, one thread, 640x640, 300 queries, 80 classes")
    logits, boxes = rng.normal(-4, 2, (300, 80)).astype(np.float32), rng.random((300, 4), np.float32)
    tensor = np.empty((1, 3, *SIZE_WH[::-1]), np.float32)
    recipes = (InputRecipe(SIZE_WH, "antialias"), InputRecipe(SIZE_WH, "linear"))
    for width, height in ((960, 540), (1280, 720), (1920, 1080)):
        image = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
        steps: dict[str, Callable[[], object]] = {
            f"prepare, {recipe.resample}": lambda i=image, r=recipe: fill_input([i], tensor, r) for recipe in recipes
        }
        steps["decode"] = lambda s=(width, height): decode_logits(logits, boxes, s)
        for step, timing in interleaved(steps, 5 * rounds).items():
            table.add_row(f"{width}x{height}", step, f"{1e3 * np.median(timing.cpu_s):.2f}")
    console.print(table)


@dataclass(frozen=True, slots=True)
class Upload:
    """One frame as the cloud sees it."""

    image: np.ndarray
    region: np.ndarray
    frame: Frame


def truth_uploads(frames: list[Frame]) -> list[Upload]:
    """The region is the true boxes, grown by 15 % of their size and at least 8 px."""
    uploads = []
    for frame in frames:
        region = np.zeros(frame.size_hw, np.bool_)
        for x0, y0, x1, y1 in frame.truth.boxes_xyxy[seen(frame)]:
            dx, dy = max(0.15 * (x1 - x0), 8), max(0.15 * (y1 - y0), 8)
            region[max(int(y0 - dy), 0) : int(y1 + dy), max(int(x0 - dx), 0) : int(x1 + dx)] = True
        region = RoiMask.from_pixels(region, 8).pixels()
        uploads.append(Upload(frame.image * region[..., None], region, frame))
    return uploads


def tracker_uploads(frames: list[Frame]) -> list[Upload]:
    """The region is the edge's own, told the true mask inside what it sent; keyframes are left out."""
    tracker = RoiTracker(RoiConfig(), block_size=8)
    uploads = []
    for frame in frames:
        proposal = tracker.propose(frame)
        region = np.ones(frame.size_hw, np.bool_) if proposal.keyframe else proposal.roi.pixels()
        tracker.update(frame.index, (frame.truth.instance_mask > 0) & region)
        if not proposal.keyframe:
            uploads.append(Upload(frame.image * region[..., None], region, frame))
    return uploads


def seen(frame: Frame) -> np.ndarray:
    """Objects that can be asked for, bool [N]."""
    height = frame.truth.boxes_xyxy[:, 3] - frame.truth.boxes_xyxy[:, 1]
    return (height >= SEEN_HEIGHT) & (frame.truth.visibility >= SEEN_SHARE)


def compare_crop(console: Console, frames_per_seed: int) -> None:
    """Average precision and time with and without the window around the region."""
    path = embedded_detector_path()
    table = Table(
        "region", "window", "shown", "frames", "AP50", "AP50 <32 px", "AP50 ≥32 px", "CPU ms", title="crop=roi"
    )
    by_truth, by_tracker = [], []
    for seed in CROP_SEEDS:
        by_truth += truth_uploads(frames_of(seed, frames_per_seed, 20))
        # the tracker needs frames in a row; every fifth is judged
        by_tracker += tracker_uploads(frames_of(seed, 5 * frames_per_seed, 1))[::5]
    for name, uploads in (("true boxes, grown", by_truth), ("the edge's tracker", by_tracker)):
        windows = [crop_window(upload.region, CropConfig()) for upload in uploads]
        sides = [
            (window.right - window.left) / upload.image.shape[1]
            for window, upload in zip(windows, uploads, strict=True)
        ]
        for shown, crop in (("whole frame", None), ("window", CropConfig())):
            detector = OnnxDetector(path, settings=DetectorSettings(min_score=0.01, crop=crop))
            started = time.process_time()
            found = [detector.detect([upload.image], [upload.region])[0] for upload in uploads]
            cpu_ms = 1e3 * (time.process_time() - started) / len(uploads)
            table.add_row(
                name, f"{np.mean(sides):.0%} of the side", shown, str(len(uploads)),
                *(f"{mean_ap50(found, uploads, *heights):.3f}" for heights in HEIGHTS),
                f"{cpu_ms:.1f}",
            )  # fmt: skip
    console.print(table)


def mean_ap50(found: list[DetectedBoxes], uploads: list[Upload], low: float, high: float) -> float:
    """Mean over classes, of objects whose height in pixels lies in low..high."""
    truth = []
    for upload in uploads:
        real = upload.frame.truth
        height = real.boxes_xyxy[:, 3] - real.boxes_xyxy[:, 1]
        truth.append(Truth(real.boxes_xyxy, real.class_ids, seen(upload.frame) & (height >= low) & (height < high)))
    figures = [class_figures(found, truth, index, 0.4) for index in CLASSES]
    return float(np.mean([figure.ap50 for figure in figures if figure.objects]))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--networks", nargs="*", default=["r18", "r50"], choices=["r18", "r50"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--parts", nargs="+", default=["networks", "edges", "crop"], choices=["networks", "edges", "crop"]
    )
    parser.add_argument("--crop-frames", type=int, default=5, help="frames judged of each of 8 rendered drives")
    options = parser.parse_args()
    console = Console(width=130)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    if "edges" in options.parts:
        compare_edges(options.rounds, console)
    if "crop" in options.parts:
        compare_crop(console, options.crop_frames)
    if "networks" in options.parts:
        images = [frame.image for frame in frames_of(91_300, 3, 20)]
        with tempfile.TemporaryDirectory() as folder:
            for name in options.networks:
                compare_network(name, Path(folder), options.rounds, images, console)


if __name__ == "__main__":
    main()
