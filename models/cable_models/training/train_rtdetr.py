"""Trains the compact RT-DETR from scratch on labelled images, on a CPU thread or a GPU."""

from __future__ import annotations

import argparse
import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.torch import load_model, save_model
from torch import nn
from transformers import RTDetrForObjectDetection

from cable_models.errors import ModelError
from cable_models.rtdetr.compact import CompactRtDetrConfig, build_compact_rtdetr, parameter_count
from cable_models.rtdetr.export import detect_with_torch
from cable_models.rtdetr.labels import coco_index_table
from cable_models.rtdetr.preprocess import fill_input
from cable_models.training.augment import AugmentConfig, augment
from cable_models.training.average_precision import ClassFigures, Truth, class_figures
from cable_models.training.samples import LabelledImage, SampleEntry, learnable, read_entries

log = logging.getLogger(__name__)

OPERATING_SCORE = 0.4


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """How the embedded detector is trained. The learning rate follows the share of ``minutes`` gone."""

    minutes: float = 30.0
    batch: int = 8
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    warmup_steps: int = 80
    gradient_norm: float = 0.1
    average_decay: float = 0.998
    """Decay of the running average of the weights, which is what is evaluated and kept."""
    coarse_share: float = 0.45
    """First share of the time, spent at three quarters of the input size: cheaper steps while shapes form."""
    checkpoint_minutes: float = 3.0
    min_height: float = 12 / 540
    """Smallest object taught and scored, as a share of the image height."""
    min_visibility: float = 0.25
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Quality on held-out images, by COCO-80 index."""

    classes: dict[int, ClassFigures]

    @property
    def mean_ap50(self) -> float:
        """Mean over the classes that occur."""
        values = [figures.ap50 for figures in self.classes.values() if figures.objects]
        return float(np.mean(values)) if values else 0.0

    def as_json(self) -> str:
        """One line of JSON."""
        rows = {
            index: {
                "objects": figures.objects,
                "ap50": round(figures.ap50, 4) if figures.objects else None,
                "precision": round(figures.precision, 4),
                "recall": round(figures.recall, 4),
                "f1": round(figures.f1, 4),
            }
            for index, figures in self.classes.items()
        }
        return json.dumps({"mean_ap50": round(self.mean_ap50, 4), "classes": rows})


def train(
    samples: Iterator[LabelledImage],
    held_out: Sequence[LabelledImage],
    network: CompactRtDetrConfig,
    config: TrainConfig,
    checkpoint: Path,
    clock: Callable[[], float] = time.monotonic,
) -> Evaluation:
    """Trains for ``config.minutes`` and leaves the best averaged weights in ``checkpoint``.

    Args:
        samples: Endless training images.
        held_out: Images of scenes that are not in ``samples``.
        network: Size of the network.
        config: Schedule.
        checkpoint: safetensors file to write, replaced whenever the held-out mean AP50 rises.
        clock: Seconds, monotonic.

    Returns:
        The evaluation of the weights in ``checkpoint``.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    model = build_compact_rtdetr(network)
    average = build_compact_rtdetr(network)
    average.load_state_dict(model.state_dict())
    average.train(False)
    optimiser = torch.optim.AdamW(parameter_groups(model, config.weight_decay), lr=config.learning_rate)
    log.info("%d parameters, %.1f minutes", parameter_count(model), config.minutes)
    start = evaluated = clock()
    best: Evaluation | None = None
    losses: list[float] = []
    step = 0
    while (gone := (clock() - start) / (60 * config.minutes)) < 1:
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(config, step, gone)
        size_wh = training_size(network.input_size_wh, gone < config.coarse_share)
        pixels, targets = next_batch(samples, network, config, size_wh, rng)
        losses.append(train_step(model, optimiser, pixels, targets, config.gradient_norm))
        step += 1
        update_average(average, model, min(config.average_decay, (1 + step) / (10 + step)))
        if clock() - evaluated >= 60 * config.checkpoint_minutes:
            best = keep_better(average, held_out, network, config, checkpoint, best)
            log.info("step %d, %.0f%% gone, loss %.2f", step, 100 * gone, float(np.mean(losses[-100:])))
            evaluated = clock()
    return keep_better(average, held_out, network, config, checkpoint, best)


def train_step(
    model: RTDetrForObjectDetection,
    optimiser: torch.optim.Optimizer,
    pixels: torch.Tensor,
    targets: list[dict[str, torch.Tensor]],
    gradient_norm: float,
) -> float:
    """One step of gradient descent; returns the loss."""
    model.train()
    loss = model(pixel_values=pixels, labels=targets).loss
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(model.parameters(), gradient_norm)
    optimiser.step()
    return float(loss.detach())


def keep_better(
    average: RTDetrForObjectDetection,
    held_out: Sequence[LabelledImage],
    network: CompactRtDetrConfig,
    config: TrainConfig,
    checkpoint: Path,
    best: Evaluation | None,
) -> Evaluation:
    """Evaluates, and writes the weights where they beat the best so far, whose evaluation is returned."""
    evaluation = evaluate(average, held_out, network, config)
    log.info("held out: %s", evaluation.as_json())
    if best is not None and evaluation.mean_ap50 < best.mean_ap50:
        return best
    save_model(average, str(checkpoint))
    return evaluation


def parameter_groups(model: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Weights with decay; biases and norm gains without."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return [
        {"params": [p for p in parameters if p.ndim > 1], "weight_decay": weight_decay},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]


def learning_rate(config: TrainConfig, step: int, gone: float) -> float:
    """Linear warm-up over steps, then half a cosine over time down to 2 %."""
    warm = min(1.0, (step + 1) / config.warmup_steps)
    return config.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(gone, 1.0))))


def training_size(size_wh: tuple[int, int], coarse: bool) -> tuple[int, int]:
    """The input size, or about three quarters of it, in multiples of the coarsest stride."""
    if not coarse:
        return size_wh
    return 32 * math.ceil(0.75 * size_wh[0] / 32), 32 * math.ceil(0.75 * size_wh[1] / 32)


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Exponential moving average of weights and batch-norm statistics, in place."""
    current = model.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - decay)
        else:
            value.copy_(current[name])


def next_batch(
    samples: Iterator[LabelledImage],
    network: CompactRtDetrConfig,
    config: TrainConfig,
    size_wh: tuple[int, int],
    rng: np.random.Generator,
) -> tuple[torch.Tensor, list[dict[str, torch.Tensor]]]:
    """The next augmented batch: pixels float32 [N, 3, H, W] and targets as transformers wants them."""
    class_of = {int(coco): index for index, coco in enumerate(coco_index_table(dict(enumerate(network.labels))))}
    images, targets = [], []
    for _ in range(config.batch):
        sample = augment(next(samples), size_wh, AugmentConfig(), rng)
        boxes = sample.boxes_xyxy
        taught = learnable(boxes, sample.visibility, size_wh[1], config.min_height, config.min_visibility)
        taught &= np.isin(sample.class_ids, list(class_of))
        corners = boxes[taught] / np.array([*size_wh, *size_wh], np.float32)
        low, high = corners[:, :2], corners[:, 2:]
        centre_size = np.concatenate([(low + high) / 2, high - low], axis=1)
        labels = [class_of[int(index)] for index in sample.class_ids[taught]]
        images.append(sample.image)
        targets.append(
            {
                "class_labels": torch.tensor(labels, dtype=torch.int64),
                "boxes": torch.from_numpy(centre_size.astype(np.float32)),
            }
        )
    tensor = np.empty((len(images), 3, size_wh[1], size_wh[0]), np.float32)
    fill_input(images, tensor)
    return torch.from_numpy(tensor), targets


def evaluate(
    model: RTDetrForObjectDetection,
    held_out: Sequence[LabelledImage],
    network: CompactRtDetrConfig,
    config: TrainConfig,
) -> Evaluation:
    """AP50 and figures at the operating score for every class, on images as a user would give them."""
    table = coco_index_table(dict(enumerate(network.labels)))
    truth = [
        Truth(
            sample.boxes_xyxy,
            sample.class_ids,
            learnable(
                sample.boxes_xyxy,
                sample.visibility,
                sample.image.shape[0],
                config.min_height,
                config.min_visibility,
            ),
        )
        for sample in held_out
    ]
    found = [detect_with_torch(model, network, sample.image, 0.01) for sample in held_out]
    return Evaluation({int(c): class_figures(found, truth, int(c), OPERATING_SCORE) for c in table})


def endless_samples(folder: Path, seed: int, reread_every: int = 400) -> Iterator[LabelledImage]:
    """Images of a folder in random order, rare classes more often; new files are taken up as they appear.

    Args:
        folder: Sample folder.
        seed: Of the random order.
        reread_every: Images after which the label file is read again.

    Raises:
        ModelError: the folder holds no samples.
    """
    rng = np.random.default_rng(seed)
    while True:
        entries = read_entries(folder)
        if not entries:
            raise ModelError(f"{folder} holds no samples; render a training set into it first")
        weights = sampling_weights(entries)
        for index in rng.choice(len(entries), reread_every, p=weights):
            yield entries[int(index)].load()


def sampling_weights(entries: Sequence[SampleEntry]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Probability of each image: by its rarest class, square root of the inverse frequency, float64 [N]."""
    holds: dict[int, int] = {}
    for entry in entries:
        for index in set(entry.class_ids.tolist()):
            holds[index] = holds.get(index, 0) + 1
    rarity = {index: (len(entries) / count) ** 0.5 for index, count in holds.items()}
    rarest = [max((rarity[i] for i in entry.class_ids.tolist()), default=0.5) for entry in entries]
    weights = np.array(rarest)
    return np.asarray(weights / weights.sum(), np.float64)


def load_weights(network: CompactRtDetrConfig, checkpoint: Path) -> RTDetrForObjectDetection:
    """The model with weights that ``train`` left.

    Raises:
        ModelError: no such file, or it belongs to a network of another size.
    """
    model = build_compact_rtdetr(network)
    try:
        load_model(model, str(checkpoint))
    except (OSError, RuntimeError) as error:
        raise ModelError(f"{checkpoint} holds no weights for {network}: {error}") from error
    return model.train(False)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m cable_models.training.train_rtdetr TRAIN_DIR HELD_OUT_DIR CHECKPOINT``."""
    parser = argparse.ArgumentParser(description="Train the compact RT-DETR on folders of labelled images.")
    parser.add_argument("train_folder", type=Path)
    parser.add_argument("held_out_folder", type=Path)
    parser.add_argument("checkpoint", type=Path, help="safetensors file to write")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(1)
    config = replace(TrainConfig(), minutes=options.minutes, seed=options.seed)
    held_out = [entry.load() for entry in read_entries(options.held_out_folder)]
    samples = endless_samples(options.train_folder, options.seed)
    train(samples, held_out, CompactRtDetrConfig(), config, options.checkpoint)


if __name__ == "__main__":
    main()
