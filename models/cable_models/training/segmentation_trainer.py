"""One stage of training: optimisers, schedule, running average, checkpoints. What is learned is the caller's loss."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cable_models.training.segmentation_muon import Muon
from cable_models.training.segmentation_state import RunState

log = logging.getLogger(__name__)

SLOW_PACE = 0.3

LossTerms = Mapping[str, Tensor]
"""Loss terms by name; their sum is minimised."""


@dataclass(frozen=True, slots=True)
class StageConfig:
    """How one stage is trained. The learning rate follows the share of ``minutes`` gone."""

    minutes: float
    steps: int | None = None
    """Length in steps instead of minutes, which repeats exactly."""
    learning_rate: float = 2e-3
    matrix_rate: float = 5e-3
    """Of the matrices inside transformer blocks, which Muon trains (rate in AdamW's scale)."""
    weight_decay: float = 0.02
    warmup_steps: int = 40
    gradient_norm: float = 1.0
    average_decay: float = 0.995
    checkpoint_minutes: float = 1.0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class StageProgress:
    """Where a stage stands, told at every checkpoint."""

    step: int
    gone: float
    """Share of the stage, 0..1."""
    losses: Mapping[str, float]
    """Means since the last report."""


def train_stage(
    model: nn.Module,
    loss: Callable[[np.random.Generator], LossTerms],
    config: StageConfig,
    checkpoint: Path,
    report: Callable[[StageProgress, Mapping[str, Tensor]], None],
    *,
    slow: Sequence[nn.Module] = (),
    should_stop: Callable[[], bool] = lambda: False,
    clock: Callable[[], float] = time.monotonic,
) -> bool:
    """Trains until ``config.minutes`` are spent, earlier runs on the same checkpoint included.

    Args:
        model: Trained in place.
        loss: Draws a batch with the generator it is given and returns the loss terms.
        config: Schedule.
        checkpoint: File to go on from where it exists, rewritten every ``checkpoint_minutes`` and at the end.
        report: Told the progress and the averaged weights at every checkpoint.
        slow: Parts that learn at `SLOW_PACE` of the rate.
        should_stop: Asked before every step.
        clock: Seconds, monotonic.

    Returns:
        Whether the stage has come to its end; False where it was stopped.

    Raises:
        ModelError: ``checkpoint`` is of another training.
    """
    torch.manual_seed(config.seed)
    average = {name: value.detach().clone() for name, value in model.state_dict().items()}
    state = RunState(model, average, make_optimisers(model, config, slow), np.random.default_rng(config.seed))
    if checkpoint.is_file():
        state.load(checkpoint)
        log.info("%s: going on at step %d, %.1f minutes used", checkpoint.name, state.step, state.used_s / 60)
    means = Means()
    start = saved = clock()
    earlier = state.used_s
    model.train()
    while (gone := share_gone(config, state)) < 1 and not should_stop():
        set_rates(state.optimisers, config, state.step, gone)
        terms = loss(state.rng)
        descend(model, state.optimisers, terms, config.gradient_norm)
        state.step += 1
        state.blend(config.average_decay)
        means.add(terms)
        state.used_s = earlier + clock() - start
        if clock() - saved >= 60 * config.checkpoint_minutes:
            state.save(checkpoint)
            report(StageProgress(state.step, gone, means.taken()), state.average)
            saved = clock()
    state.save(checkpoint)
    gone = share_gone(config, state)
    report(StageProgress(state.step, gone, means.taken()), state.average)
    return gone >= 1


def share_gone(config: StageConfig, state: RunState) -> float:
    """Share of a stage that lies behind, 0..1."""
    gone = state.used_s / (60 * config.minutes) if config.steps is None else state.step / config.steps
    return min(1.0, gone)


class Means:
    """Means of loss terms between two reports."""

    def __init__(self) -> None:
        self.sums: dict[str, float] = {}
        self.count = 0

    def add(self, terms: LossTerms) -> None:
        """One more step's terms."""
        self.count += 1
        for name, value in terms.items():
            self.sums[name] = self.sums.get(name, 0.0) + float(value.detach())

    def taken(self) -> dict[str, float]:
        """The means so far, from which on counting begins anew."""
        means = {name: total / self.count for name, total in self.sums.items()}
        self.sums, self.count = {}, 0
        return means


def make_optimisers(model: nn.Module, config: StageConfig, slow: Sequence[nn.Module]) -> list[torch.optim.Optimizer]:
    """Muon for the matrices inside transformer blocks, AdamW for everything else."""
    slowed = {id(parameter) for module in slow for parameter in module.parameters()}
    matrices: dict[float, list[Tensor]] = {1.0: [], SLOW_PACE: []}
    others: dict[tuple[float, bool], list[Tensor]] = {}
    for name, parameter in model.named_parameters():
        if not parameter.requires_grad:
            continue
        pace = SLOW_PACE if id(parameter) in slowed else 1.0
        if parameter.ndim == 2 and ".layers." in name and "embed" not in name:
            matrices[pace].append(parameter)
        else:
            others.setdefault((pace, parameter.ndim > 1), []).append(parameter)
    adam: list[dict[str, Any]] = [
        {"params": parameters, "pace": pace, "weight_decay": config.weight_decay if decays else 0.0}
        for (pace, decays), parameters in others.items()
    ]
    optimisers: list[torch.optim.Optimizer] = [torch.optim.AdamW(adam, lr=config.learning_rate, betas=(0.9, 0.98))]
    muon = [{"params": parameters, "pace": pace} for pace, parameters in matrices.items() if parameters]
    if muon:
        optimisers.append(Muon(muon, lr=config.matrix_rate, weight_decay=config.weight_decay))
    return optimisers


def set_rates(optimisers: Sequence[torch.optim.Optimizer], config: StageConfig, step: int, gone: float) -> None:
    """Linear warm-up over steps, then half a cosine over time down to 2 %."""
    share = min(1.0, (step + 1) / config.warmup_steps) * (0.02 + 0.49 * (1 + math.cos(math.pi * min(gone, 1.0))))
    for optimiser in optimisers:
        base = config.matrix_rate if isinstance(optimiser, Muon) else config.learning_rate
        for group in optimiser.param_groups:
            group["lr"] = base * group["pace"] * share


def descend(
    model: nn.Module, optimisers: Sequence[torch.optim.Optimizer], terms: LossTerms, gradient_norm: float
) -> None:
    """One step of gradient descent."""
    for optimiser in optimisers:
        optimiser.zero_grad(set_to_none=True)
    torch.autograd.backward(torch.stack(list(terms.values())).sum())
    nn.utils.clip_grad_norm_([p for p in model.parameters() if p.requires_grad], gradient_norm)
    for optimiser in optimisers:
        optimiser.step()
