"""What a training run needs to go on where it stopped, on disk."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cable_models.errors import ModelError


@dataclass(slots=True)
class RunState:
    """Everything that changes while training."""

    model: nn.Module
    average: dict[str, Tensor]
    """Running average of the model's state, what is evaluated and exported."""
    optimisers: list[torch.optim.Optimizer]
    rng: np.random.Generator
    step: int = 0
    used_s: float = 0.0
    """Time spent."""

    def save(self, path: Path) -> None:
        """Writes a checkpoint; the old one stays until the new one is whole."""
        record = {
            "model": self.model.state_dict(),
            "average": self.average,
            "optimisers": [optimiser.state_dict() for optimiser in self.optimisers],
            "numpy_rng": json.dumps(self.rng.bit_generator.state),
            "torch_rng": torch.get_rng_state(),
            "step": self.step,
            "used_s": self.used_s,
        }
        partial = path.with_suffix(".part")
        torch.save(record, partial)
        os.replace(partial, path)

    def load(self, path: Path) -> None:
        """Takes up a checkpoint.

        Raises:
            ModelError: it can't be read or belongs to another model.
        """
        record = read_record(path)
        try:
            self.model.load_state_dict(record["model"])
            self.average = {name: value.clone() for name, value in record["average"].items()}
            for optimiser, saved in zip(self.optimisers, record["optimisers"], strict=True):
                optimiser.load_state_dict(saved)
            self.rng.bit_generator.state = json.loads(record["numpy_rng"])
            torch.set_rng_state(record["torch_rng"])
            self.step, self.used_s = int(record["step"]), float(record["used_s"])
        except (KeyError, ValueError, RuntimeError) as error:
            raise ModelError(f"{path} isn't of this training; move it away to start anew: {error}") from error

    def blend(self, decay: float) -> None:
        """Moves the average towards the model; the first steps count more than ``decay`` lets them."""
        share = 1 - min(decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                if value.dtype.is_floating_point:
                    self.average[name].lerp_(value, share)
                else:
                    self.average[name].copy_(value)


def averaged(path: Path) -> Mapping[str, Tensor]:
    """The averaged weights of a checkpoint.

    Raises:
        ModelError: it can't be read.
    """
    average: Mapping[str, Tensor] = read_record(path)["average"]
    return average


def read_record(path: Path) -> dict[str, Any]:
    """A checkpoint's content.

    Raises:
        ModelError: it can't be read.
    """
    try:
        record: dict[str, Any] = torch.load(path, weights_only=True)
    except (OSError, RuntimeError, ValueError) as error:
        raise ModelError(f"{path} can't be read as a checkpoint: {error}") from error
    return record
