"""Makes the embedded detector: renders scenes, trains the compact RT-DETR on them, exports and checks it.

``python -m cable_rpc.study.train_embedded WORK_DIR`` does all of it on one CPU thread. Single steps can be named,
so that rendering and training run side by side: training takes up new frames as they appear.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from cable_models.embedded import EMBEDDED_DETECTOR
from cable_models.rtdetr.compact import CompactRtDetrConfig
from cable_models.rtdetr.export import export_onnx, verify_export
from cable_models.training.samples import LabelledImage, append_sample, read_entries
from cable_models.training.train_rtdetr import TrainConfig, endless_samples, evaluate, load_weights, train

from cable_rpc.data.synthetic import SyntheticConfig, SyntheticSource
from cable_rpc.errors import SourceError
from cable_rpc.types import Frame

log = logging.getLogger(__name__)

TRAINING_SEEDS = range(10_000, 10_300)
HELD_OUT_SEEDS = range(90_000, 90_042)
"""Far from the seeds of demos, tests and studies, so that those show scenes the detector never saw."""

SEQUENCE_FRAMES = 120
CHECKPOINT = "rtdetr_compact.safetensors"
STEPS = ("render-held-out", "render-train", "train", "export")
VERIFIED_IMAGES = 24


@dataclass(frozen=True, slots=True)
class RenderPlan:
    """Which frames are rendered."""

    seeds: range
    frames_per_seed: int
    width: int
    height: int

    def frame_indices(self, seed: int) -> list[int]:
        """Frames spread over the sequence, at another offset for each seed."""
        stride = SEQUENCE_FRAMES // self.frames_per_seed
        return [seed % stride + stride * position for position in range(self.frames_per_seed)]


TRAINING_PLAN = RenderPlan(TRAINING_SEEDS, frames_per_seed=10, width=512, height=288)
HELD_OUT_PLAN = RenderPlan(HELD_OUT_SEEDS, frames_per_seed=2, width=640, height=360)


def render_into(folder: Path, plan: RenderPlan) -> None:
    """Renders what is missing of a plan into a sample folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in plan.seeds:
        names = {index: f"{seed:06d}_{index:03d}" for index in plan.frame_indices(seed)}
        missing = {index: name for index, name in names.items() if not (folder / f"{name}.jpg").is_file()}
        if missing:
            source = SyntheticSource(
                SyntheticConfig(seed=seed, width=plan.width, height=plan.height, frame_count=SEQUENCE_FRAMES)
            )
            for index, name in missing.items():
                append_sample(folder, name, labelled(source.frame(index)))


def labelled(frame: Frame) -> LabelledImage:
    """A rendered frame with its truth, as the training code takes it.

    Raises:
        SourceError: the frame has no truth.
    """
    if frame.truth is None:
        raise SourceError(f"frame {frame.index} has no truth to learn from; render it with a truth-giving source")
    truth = frame.truth
    return LabelledImage(frame.image, truth.boxes_xyxy, truth.class_ids, truth.visibility)


def train_checkpoint(work: Path, config: TrainConfig) -> None:
    """Trains on ``work/train``, keeps the weights that do best on ``work/held_out``.

    Raises:
        cable_models.ModelError: the rendered folders are missing.
    """
    held_out = [entry.load() for entry in read_entries(work / "held_out")]
    samples = endless_samples(work / "train", config.seed)
    train(samples, held_out, CompactRtDetrConfig(), config, work / CHECKPOINT)


def export_checkpoint(work: Path, target: Path, config: TrainConfig) -> None:
    """Exports the trained weights, checks the file against torch and logs its held-out figures.

    Raises:
        cable_models.ModelError: there are no weights, or the export differs from torch.
    """
    network = CompactRtDetrConfig()
    held_out = [entry.load() for entry in read_entries(work / "held_out")]
    model = load_weights(network, work / CHECKPOINT)
    notes = {
        "source": "trained from scratch on rendered scenes by `python -m cable_rpc.study.train_embedded`",
        "licence": "Apache-2.0",
        "operating_score": "0.4",
    }
    export_onnx(model, network, target, notes)
    images = [sample.image for sample in held_out[:VERIFIED_IMAGES]]
    box_px, score = verify_export(model, network, target, images)
    log.info("%s: %d bytes, within %.4f px and %.6f of torch", target, target.stat().st_size, box_px, score)
    log.info("held out: %s", evaluate(model, held_out, network, config).as_json())


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Render, train and export the embedded detector.")
    parser.add_argument("work", type=Path, help="folder for rendered frames and checkpoints")
    parser.add_argument("--target", type=Path, help=f"ONNX file to write, WORK/{EMBEDDED_DETECTOR} by default")
    parser.add_argument("--minutes", type=float, default=30.0, help="training time")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    cv2.setNumThreads(options.threads)
    torch.set_num_threads(options.threads)
    target = options.target or options.work / EMBEDDED_DETECTOR
    config = replace(TrainConfig(), minutes=options.minutes)
    if "render-held-out" in options.steps:
        render_into(options.work / "held_out", HELD_OUT_PLAN)
    if "render-train" in options.steps:
        render_into(options.work / "train", TRAINING_PLAN)
    if "train" in options.steps:
        train_checkpoint(options.work, config)
    if "export" in options.steps:
        export_checkpoint(options.work, target, config)


if __name__ == "__main__":
    main()
