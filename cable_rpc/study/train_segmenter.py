"""Makes the embedded segmenter: renders scenes with instance masks, trains the compact LISA, saves and judges it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from cable_codecs import diffuse_background
from cable_models.training.segmentation_evaluation import MaskFigures, evaluate_masks
from cable_models.training.segmentation_export import export_segmenter, pipeline_segmenter
from cable_models.training.segmentation_samples import SegmentedImage, append_segmented, read_segmented
from cable_models.training.segmentation_stages import TIME_SHARES, SegmenterTraining, Stage, run_stage
from cable_models.training.segmentation_trainer import StageConfig, StageProgress

from cable_rpc.errors import SourceError
from cable_rpc.study.rendered_frames import HELD_OUT_SEEDS, RenderPlan, labelled
from cable_rpc.types import Frame

TRAINING_PLAN = RenderPlan(range(20_000, 30_000), frames_per_seed=8, width=512, height=288, vary=True)
HELD_OUT_PLAN = RenderPlan(HELD_OUT_SEEDS, frames_per_seed=3, width=640, height=360, vary=False)

CAMVID_CLASSES = {8: 1, 9: 2, 10: 3}
"""CamVid's car, pedestrian and bicyclist among SegNet's 12 classes, and the class numbers of a `SegmentedImage`."""

CHECKPOINT_FOLDER = "lisa_compact"

Listener = Callable[[Stage, StageProgress, MaskFigures | None], None]
"""Told where a stage stands, and the held-out figures of the masks it makes by then."""


@dataclass(frozen=True, slots=True)
class SegmenterFigures:
    """Held-out quality of a saved segmenter, through the pipeline that serves it."""

    whole: MaskFigures
    masked: MaskFigures
    """With all but a region around the true objects replaced as the service does."""


def write_segmented(folder: Path, name: str, frame: Frame) -> None:
    """Writes a rendered frame as a sample of a segmenter's training; a writer for `render_into`.

    Raises:
        SourceError: the frame has no instance mask.
    """
    sample = labelled(frame)
    if frame.truth is None or frame.truth.instance_mask is None:
        raise SourceError(f"frame {frame.index} has no instance mask to learn from; render it with the synthetic world")
    append_segmented(folder, name, sample, frame.truth.instance_mask)


def held_out(work: Path) -> list[SegmentedImage]:
    """The frames to judge by.

    Raises:
        cable_models.ModelError: they are missing or damaged.
    """
    return [entry.load() for entry in read_segmented(work / "held_out")]


def train_segmenter(
    training: SegmenterTraining,
    stages: Sequence[Stage],
    config: StageConfig,
    listener: Listener,
    should_stop: Callable[[], bool] = lambda: False,
) -> bool:
    """Trains stages one after the other, each for its share of ``config.minutes``.

    Args:
        training: Folder with rendered frames, and sizes.
        stages: Which ones, in this order.
        config: Schedule of the whole training; ``steps``, where given, count for each stage.
        listener: Told at every checkpoint.
        should_stop: Asked before every step.

    Returns:
        Whether all stages have come to their end.

    Raises:
        cable_models.ModelError: frames are missing, or a checkpoint is of another training.
    """
    images = held_out(training.work)
    for stage in stages:
        part = replace(config, minutes=config.minutes * TIME_SHARES[stage])
        finished = run_stage(
            training,
            stage,
            part,
            lambda progress, segment, stage=stage: listener(  # type: ignore[misc]
                stage, progress, None if segment is None else evaluate_masks(segment, images)
            ),
            should_stop,
        )
        if not finished:
            return False
    return True


def save_segmenter(training: SegmenterTraining, folder: Path) -> Path:
    """Writes the checkpoint folder in float16; ``folder`` must be new or empty.

    Raises:
        cable_models.ModelError: a stage was never run, or the folder can't be written.
    """
    return export_segmenter(training, folder)


def camvid_frames(folder: Path) -> list[SegmentedImage]:
    """Real frames with dense labels: CamVid as SegNet's authors distribute it, 12 classes.

    Args:
        folder: Holds ``images`` and ``labels``, PNG files of the same names.

    Raises:
        SourceError: there are none, or a pair can't be read.
    """
    paths = sorted((folder / "images").glob("*.png"))
    if not paths:
        raise SourceError(f"{folder} holds no images/*.png; name a folder of CamVid with images and labels")
    table = np.zeros(256, np.uint8)
    for label, number in CAMVID_CLASSES.items():
        table[label] = number
    frames = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        labels = cv2.imread(str(folder / "labels" / path.name), cv2.IMREAD_UNCHANGED)
        if image is None or labels is None or image.shape[:2] != labels.shape:
            raise SourceError(f"{path} and its label image can't be read, or differ in size")
        frames.append(SegmentedImage(np.asarray(image, np.uint8), labels.astype(np.uint16), table))
    return frames


def judge_segmenter(folder: Path, images: Sequence[SegmentedImage]) -> SegmenterFigures:
    """Held-out figures of a checkpoint folder through the pipeline."""
    segment = pipeline_segmenter(folder)
    return SegmenterFigures(evaluate_masks(segment, images), evaluate_masks(segment, images, diffuse_background))
