"""CLIP's share of LISA++: patch features of whole frames, or of the patches that meet the region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn.utils.rnn import pad_sequence

from cable_models.lisa.model import LisaModel


def patch_features(
    model: LisaModel, pixels: torch.Tensor, kept: Sequence[torch.Tensor | None] | None = None
) -> list[torch.Tensor]:
    """Features that enter the projector: hidden state ``select_layer`` of CLIP.

    Dropping patches before CLIP changes the features of those that stay, for they no longer see the others.

    Args:
        model: The network.
        pixels: float [B, 3, S, S], normalised RGB.
        kept: For each frame the row-major numbers (int64 [n]) of the patches that CLIP computes, None = all.
            None in place of the list = all patches of all frames.

    Returns:
        For each frame [n, clip width], without the class token.
    """
    tower = clip_transformer(model.vision_tower)
    embedded = tower.embeddings(pixels.to(model.dtype))
    if kept is None or all(numbers is None for numbers in kept):
        hidden = run_layers(model, tower.pre_layrnorm(embedded), None)
        return list(hidden[:, 1:])
    rows = [
        frame if numbers is None else torch.cat([frame[:1], frame[1:].index_select(0, numbers)])
        for frame, numbers in zip(embedded, kept, strict=True)
    ]
    lengths = [len(row) for row in rows]
    padded = pad_sequence(rows, batch_first=True)
    hidden = run_layers(model, tower.pre_layrnorm(padded), key_mask(lengths, padded))
    return [frame[1:length] for frame, length in zip(hidden, lengths, strict=True)]


def project(model: LisaModel, features: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Image tokens [n, language width] of each frame's patch features [n, clip width], in one call."""
    lengths = [len(frame) for frame in features]
    return list(model.mm_projector(torch.cat(list(features))).split(lengths))


def run_layers(model: LisaModel, hidden: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """The transformer blocks up to the selected hidden state; those above it are not needed."""
    layers = clip_transformer(model.vision_tower).encoder.layers
    selected = model.architecture.select_layer
    used = layers[: selected if selected >= 0 else len(layers) + 1 + selected]
    return model.stacks.clip(list(used), hidden, mask)


def key_mask(lengths: Sequence[int], padded: torch.Tensor) -> torch.Tensor | None:
    """Additive mask [B, 1, 1, n] that hides padding from attention; None where there is none."""
    longest = padded.shape[1]
    if min(lengths) == longest:
        return None
    positions = torch.arange(longest, device=padded.device)
    hidden = positions[None] >= torch.tensor(lengths, device=padded.device)[:, None]
    mask = torch.zeros(hidden.shape, dtype=padded.dtype, device=padded.device)
    mask.masked_fill_(hidden, torch.finfo(padded.dtype).min)
    return mask[:, None, None]


def clip_transformer(tower: nn.Module) -> Any:
    """The module that holds embeddings and encoder, which older releases of transformers wrap once more."""
    return getattr(tower, "vision_model", tower)
