"""Trains the compact RT-DETR on labelled images, on a CPU thread or a GPU; can be stopped and continued."""

from __future__ import annotations

import copy
import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_model, save_model
from torch import nn
from transformers import RTDetrForObjectDetection

from cable_models.errors import ModelError
from cable_models.rtdetr.checkpoints import COMPACT_KEY
from cable_models.rtdetr.compact import CLASS_PRIOR, CompactRtDetrConfig, build_compact_rtdetr
from cable_models.rtdetr.export import detect_with_torch
from cable_models.rtdetr.labels import coco_index_table
from cable_models.training.dense_loss import DenseHead, dense_loss
from cable_models.training.detector_batches import CLOSING_VIEWS, VIEWS, Batch, next_batch
from cable_models.training.detector_evaluation import LOWEST_SCORE, Evaluation, evaluate
from cable_models.training.detector_state import Progress, load_state, save_state
from cable_models.training.samples import LabelledImage
from cable_models.training.sampling import BalancedSampler
from cable_models.training.upload_views import CONSTANT_FILLS, WeightedFill

CLOSING_SHARE = 0.85
"""Share of the training from which on crops are no longer shown."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """How the embedded detector is trained."""

    minutes: float = 120.0
    """Training time in all; the learning rate follows the share that is gone."""
    steps: int | None = None
    """Length in steps instead: slower, but the same weights on every machine of one kind."""
    batch: int = 8
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    warmup_steps: int = 80
    gradient_norm: float = 0.1
    average_decay: float = 0.998
    """Decay of the running average of the weights, which is what is evaluated and kept."""
    dense_weight: float = 1.0
    """Weight of the training-only loss with many positives per object."""
    checkpoint_minutes: float = 5.0
    min_height_px: float = 10.0
    """Smallest object taught, in pixels of the network's input."""
    min_visibility: float = 0.25
    seed: int = 0


@dataclass(frozen=True, slots=True)
class TrainingFiles:
    """Where a training keeps its results."""

    weights: Path
    """safetensors file of the best averaged weights so far."""
    state: Path
    """Everything that a later sitting needs to go on."""


@dataclass(frozen=True, slots=True)
class StepReport:
    """What a listener hears after each step."""

    progress: Progress
    share_gone: float
    """Of the whole training, 0..1."""
    loss: float
    evaluation: Evaluation | None
    """Held-out figures, at checkpoints only."""


@dataclass(slots=True)
class Trainee:
    """The networks in training."""

    model: RTDetrForObjectDetection
    average: RTDetrForObjectDetection
    dense_head: DenseHead
    optimiser: torch.optim.Optimizer
    network: CompactRtDetrConfig

    def modules(self) -> dict[str, nn.Module]:
        """What a state file holds, by name."""
        return {"model": self.model, "average": self.average, "dense_head": self.dense_head}


def train(
    folder: Path,
    held_out: Sequence[LabelledImage],
    network: CompactRtDetrConfig,
    config: TrainConfig,
    files: TrainingFiles,
    *,
    device: str = "cpu",
    initial: Path | None = None,
    fills: Sequence[WeightedFill] = CONSTANT_FILLS,
    listener: Callable[[StepReport], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
    clock: Callable[[], float] = time.monotonic,
) -> Progress:
    """Trains, or goes on where the state file stands, and leaves the best averaged weights behind.

    Args:
        folder: Sample folder; images that appear in it meanwhile are taken up.
        held_out: Images of scenes that are not in ``folder``.
        network: Size of the network.
        config: Schedule.
        files: Weights and state to write; an existing state is continued.
        device: torch device.
        initial: Weights to start from instead of random ones; ignored where a state is continued.
        fills: What may stand outside the region in masked images.
        listener: Called after each step.
        should_stop: Asked before each step; a stop leaves a state to continue from.
        clock: Seconds, monotonic.

    Returns:
        How far the training has come.

    Raises:
        ModelError: no samples, or a state or initial weights that don't fit.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    trainee = new_trainee(network, config, device, initial)
    recipe = recipe_text(network, config)
    progress = Progress()
    if files.state.is_file():
        progress = load_state(files.state, trainee.modules(), trainee.optimiser, rng, recipe)
        log.info("continued at step %d after %.1f minutes", progress.step, progress.seconds / 60)
    sampler = BalancedSampler(folder)
    last = saved = clock()
    while share_gone(config, progress) < 1 and not should_stop():
        gone = share_gone(config, progress)
        set_learning_rate(trainee.optimiser, learning_rate(config, progress.step, gone))
        views = VIEWS if gone < CLOSING_SHARE else CLOSING_VIEWS
        batch = next_batch(
            sampler, network, config.batch, config.min_height_px, config.min_visibility, rng, views, fills
        )
        loss = train_step(trainee, batch, config, device)
        progress.step += 1
        update_average(
            trainee.average, trainee.model, min(config.average_decay, (1 + progress.step) / (10 + progress.step))
        )
        now = clock()
        progress.seconds += now - last
        last = now
        evaluation = None
        if now - saved >= 60 * config.checkpoint_minutes:
            evaluation = keep_better(trainee, held_out, files.weights, progress)
            save_state(files.state, trainee.modules(), trainee.optimiser, rng, progress, recipe)
            saved = last = clock()
        listener(StepReport(progress, gone, loss, evaluation))
    keep_better(trainee, held_out, files.weights, progress)
    save_state(files.state, trainee.modules(), trainee.optimiser, rng, progress, recipe)
    return progress


def new_trainee(network: CompactRtDetrConfig, config: TrainConfig, device: str, initial: Path | None) -> Trainee:
    """Networks and optimiser at the start.

    Raises:
        ModelError: the initial weights belong to another network.
    """
    model = load_weights(network, initial) if initial else build_compact_rtdetr(network)
    average = build_compact_rtdetr(network)
    average.load_state_dict(model.state_dict())
    average.train(False)
    levels = len(network.stage_channels) - 1
    head = DenseHead(network.width, len(network.labels), levels, CLASS_PRIOR)
    nn.ModuleList([model, average, head]).to(device)
    groups = parameter_groups(nn.ModuleList([model, head]), config.weight_decay)
    optimiser = torch.optim.AdamW(groups, lr=config.learning_rate)
    return Trainee(model, average, head, optimiser, network)


def train_step(trainee: Trainee, batch: Batch, config: TrainConfig, device: str) -> float:
    """One step of gradient descent; returns the loss."""
    trainee.model.train()
    targets = [{name: value.to(device) for name, value in target.items()} for target in batch.targets]
    output = trainee.model(pixel_values=batch.pixels.to(device), labels=targets)
    maps = output.encoder_last_hidden_state
    extra = dense_loss(
        trainee.dense_head(maps),
        output.enc_outputs_coord_logits,
        [(features.shape[2], features.shape[3]) for features in maps],
        (batch.pixels.shape[3], batch.pixels.shape[2]),
        targets,
    )
    loss = output.loss + config.dense_weight * extra
    trainee.optimiser.zero_grad(set_to_none=True)
    loss.backward()
    for module in (trainee.model, trainee.dense_head):
        nn.utils.clip_grad_norm_(module.parameters(), config.gradient_norm)
    trainee.optimiser.step()
    return float(loss.detach())


def keep_better(trainee: Trainee, held_out: Sequence[LabelledImage], weights: Path, progress: Progress) -> Evaluation:
    """Evaluates the average, and writes it where it beats the best so far."""
    # judged on the CPU, where it will run
    evaluation = evaluate_torch(copy.deepcopy(trainee.average).cpu(), held_out, trainee.network)
    log.info("step %d, held out: %s", progress.step, evaluation.as_json())
    if evaluation.mean_ap50 > progress.best:
        progress.best = evaluation.mean_ap50
        save_model(trainee.average, str(weights), metadata={COMPACT_KEY: json.dumps(asdict(trainee.network))})
    return evaluation


def evaluate_torch(
    model: RTDetrForObjectDetection, held_out: Sequence[LabelledImage], network: CompactRtDetrConfig
) -> Evaluation:
    """Held-out figures of a torch model, objects of 6 % of the image height and more."""
    coco = coco_index_table(dict(enumerate(network.labels)))
    return evaluate(
        lambda image: detect_with_torch(model, network, image, LOWEST_SCORE), held_out, [int(index) for index in coco]
    )


def parameter_groups(model: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Weights with decay; biases and norm gains without."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    return [
        {"params": [p for p in parameters if p.ndim > 1], "weight_decay": weight_decay},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]


def share_gone(config: TrainConfig, progress: Progress) -> float:
    """Share of the training that is done, by steps where their number is set, else by time."""
    if config.steps is not None:
        return progress.step / max(1, config.steps)
    return progress.seconds / (60 * config.minutes)


def learning_rate(config: TrainConfig, step: int, gone: float) -> float:
    """Linear warm-up over steps, then half a cosine down to 2 %."""
    warm = min(1.0, (step + 1) / config.warmup_steps)
    return config.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(gone, 1.0))))


def set_learning_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """The same rate for all parameters."""
    for group in optimiser.param_groups:
        group["lr"] = rate


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Exponential moving average of weights and batch-norm statistics, in place."""
    current = model.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - decay)
        else:
            value.copy_(current[name])


def recipe_text(network: CompactRtDetrConfig, config: TrainConfig) -> str:
    """What a state must have in common with the training that continues it; its length may change."""
    settings = asdict(config)
    for free in ("minutes", "steps", "checkpoint_minutes"):
        del settings[free]
    return json.dumps({"network": asdict(network), **settings})


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
