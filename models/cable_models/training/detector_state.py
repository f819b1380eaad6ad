"""Everything a stopped training needs to go on: weights, their average, optimiser, random states, progress."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from cable_models.errors import ModelError

FORMAT = "cable-training-state-1"
MODULE_PREFIX = "module/"
OPTIMISER_PREFIX = "optimiser/"
TORCH_RANDOM = "random/torch"


@dataclass(slots=True)
class Progress:
    """How far a training has come."""

    step: int = 0
    seconds: float = 0.0
    """Time trained, summed over all sittings."""
    best: float = -1.0
    """Highest held-out figure so far; -1 before the first evaluation."""


def save_state(
    path: Path,
    modules: dict[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    rng: np.random.Generator,
    progress: Progress,
    recipe: str,
) -> None:
    """Writes a training's state beside ``path`` and moves it into place, so that a kill leaves the old one whole.

    Args:
        path: safetensors file.
        modules: Networks by name, batch-norm statistics included.
        optimiser: Its moments and step counts.
        rng: Draws of sampling and augmentation.
        progress: How far it has come.
        recipe: Names network and settings; a state is only taken up by the same recipe.
    """
    tensors = {TORCH_RANDOM: torch.get_rng_state()}
    for name, module in modules.items():
        tensors |= {f"{MODULE_PREFIX}{name}/{key}": value for key, value in module.state_dict().items()}
    for index, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"{OPTIMISER_PREFIX}{index}/{key}": torch.as_tensor(value) for key, value in moments.items()}
    metadata = {
        "format": FORMAT,
        "recipe": recipe,
        "random": json.dumps(rng.bit_generator.state),
        "progress": json.dumps({"step": progress.step, "seconds": progress.seconds, "best": progress.best}),
    }
    partial = path.with_name(path.name + ".part")
    # shared parameters (RT-DETR names its decoder heads twice) would be refused: every tensor gets its own memory
    save_file({key: value.detach().cpu().clone().contiguous() for key, value in tensors.items()}, partial, metadata)
    os.replace(partial, path)


def load_state(
    path: Path,
    modules: dict[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    rng: np.random.Generator,
    recipe: str,
) -> Progress:
    """Puts a stored state into networks, optimiser and random generators.

    Returns:
        How far the training had come.

    Raises:
        ModelError: the file is damaged, no training state, or of another recipe.
    """
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - not a dict
    except (OSError, SafetensorError) as error:
        raise ModelError(f"{path} is no readable training state ({error}); delete it to start afresh") from error
    if metadata.get("format") != FORMAT:
        raise ModelError(f"{path} is no training state of this version; delete it to start afresh")
    if metadata.get("recipe") != recipe:
        raise ModelError(
            f"{path} belongs to another recipe ({metadata.get('recipe')}, wanted {recipe}); "
            "train with its settings, or name another work folder"
        )
    try:
        for name, module in modules.items():
            module.load_state_dict(stripped(tensors, f"{MODULE_PREFIX}{name}/"))
        restore_optimiser(optimiser, stripped(tensors, OPTIMISER_PREFIX))
        rng.bit_generator.state = json.loads(metadata["random"])
        torch.set_rng_state(tensors[TORCH_RANDOM])
        return Progress(**json.loads(metadata["progress"]))
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise ModelError(f"{path} is damaged ({error}); delete it to start afresh") from error


def stripped(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """The tensors under a prefix, named without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, torch.Tensor]) -> None:
    """Puts moments named ``INDEX/KEY`` back; the settings of the parameter groups stay as they are."""
    moments: dict[int, dict[str, Any]] = {}
    for name, value in tensors.items():
        index, key = name.split("/", 1)
        moments.setdefault(int(index), {})[key] = value
    optimiser.load_state_dict({"state": moments, "param_groups": optimiser.state_dict()["param_groups"]})
