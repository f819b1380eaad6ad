"""The SAM image encoder under training: with a dense class head, and on fewer than its full square of token rows.

The tables of relative positions stay zero, as a fresh SAM has them: the positions added to the tokens carry all there
is to learn here, and without a bias attention runs in fused kernels, which halves the time of a step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from cable_models.training.segmentation_samples import CLASS_NAMES

CELLS_PER_TOKEN = 4
"""Mask cells along one side of a token, as in SAM's mask decoder."""

HfModule = Any
"""A module of transformers, whose parts are untyped."""


class DenseClassHead(nn.Module):
    """Class logits of 4x4 cells from each token of the neck; teaches the encoder, and is thrown away after."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.project = nn.Conv2d(channels, (1 + len(CLASS_NAMES)) * CELLS_PER_TOKEN**2, 1)

    def forward(self, features: Tensor) -> Tensor:
        """[N, C, rows, columns] to class logits [N, 4, 4 * rows, 4 * columns]."""
        return functional.pixel_shuffle(self.project(features), CELLS_PER_TOKEN)


def encode_rows(encoder: HfModule, pixels: Tensor) -> Tensor:
    """The encoder over the token rows that ``pixels`` fills; the whole square gives the module's own numbers.

    Args:
        encoder: SAM's image encoder, its relative positions zero.
        pixels: float32 [N, 3, height, image_size], normalised; height a multiple of the patch size.

    Returns:
        [N, output channels, height / patch, columns].
    """
    projection = encoder.patch_embed.projection
    patch = projection.kernel_size[0]
    batch, channels, height, width = pixels.shape
    rows, columns = height // patch, width // patch
    cut = pixels.reshape(batch, channels, rows, patch, columns, patch).permute(0, 2, 4, 1, 3, 5)
    patches = cut.reshape(batch, rows, columns, -1)
    hidden = functional.linear(patches, projection.weight.flatten(1), projection.bias)
    if encoder.pos_embed is not None:
        hidden = hidden + encoder.pos_embed[:, :rows]
    for layer in encoder.layers:
        hidden = run_layer(layer, hidden)
    features: Tensor = encoder.neck(hidden)
    return features


def run_layer(layer: HfModule, hidden: Tensor) -> Tensor:
    """One transformer block on [N, rows, columns, C]."""
    normed = layer.layer_norm1(hidden)
    if layer.window_size:
        rows, columns = hidden.shape[1:3]
        windows, padded = layer.window_partition(normed, layer.window_size)
        mixed = layer.window_unpartition(attend(layer.attn, windows), layer.window_size, padded, (rows, columns))
    else:
        mixed = attend(layer.attn, normed)
    hidden = hidden + mixed
    out: Tensor = hidden + layer.mlp(layer.layer_norm2(hidden))
    return out


def attend(attention: HfModule, hidden: Tensor) -> Tensor:
    """SAM's attention without its (zero) relative positions, on [N, rows, columns, C]."""
    batch, rows, columns, width = hidden.shape
    heads = int(attention.num_attention_heads)
    qkv = attention.qkv(hidden).reshape(batch, rows * columns, 3, heads, width // heads).permute(2, 0, 3, 1, 4)
    mixed = functional.scaled_dot_product_attention(*qkv.unbind(0))
    out: Tensor = attention.proj(mixed.transpose(1, 2).reshape(batch, rows, columns, width))
    return out


def initialise(encoder: HfModule) -> None:
    """Weights from which a small encoder learns quickly, on one processor within minutes.

    Patch filters start as the smoothest waves (a cosine basis), most of them over luma, and tokens start with
    positions that attention can tell apart.
    """
    with torch.no_grad():
        projection = encoder.patch_embed.projection
        projection.weight.copy_(wave_filters(projection.out_channels, projection.kernel_size[0]))
        nn.init.zeros_(projection.bias)
        if encoder.pos_embed is not None:
            encoder.pos_embed.copy_(wave_positions(encoder.pos_embed.shape[1], encoder.pos_embed.shape[3]))
        spread_weights(encoder.layers)
        spread_weights(encoder.neck)
        for layer in encoder.layers:
            for last in (layer.attn.proj, layer.mlp.lin2):
                last.weight.mul_((2 * len(encoder.layers)) ** -0.5)
            for table in (layer.attn.rel_pos_h, layer.attn.rel_pos_w):
                table.zero_().requires_grad_(False)


def spread_weights(module: nn.Module) -> None:
    """Variance-keeping random weights in every linear and convolutional layer; SAM's class starts them near zero."""
    for part in module.modules():
        if isinstance(part, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
            weight = part.weight
            # A transposed convolution whose stride is its kernel sees each input once.
            fan_in = weight.shape[0] if isinstance(part, nn.ConvTranspose2d) else weight[0].numel()
            nn.init.trunc_normal_(weight, std=fan_in**-0.5)
            if part.bias is not None:
                nn.init.zeros_(part.bias)


def wave_filters(count: int, patch: int) -> Tensor:
    """Filters of a two-dimensional cosine transform, lowest frequencies first, [count, 3, patch, patch] RGB.

    Three in four look at luma, the others at blue-yellow and red-green. Responses to natural images have about
    unit variance: amplitude rises with frequency, against their 1/f spectrum.
    """
    places = (torch.arange(patch) + 0.5) / patch
    waves = torch.cos(torch.pi * torch.arange(patch)[:, None] * places)
    order = sorted(((u, v) for u in range(patch) for v in range(patch)), key=lambda uv: (uv[0] ** 2 + uv[1] ** 2, uv))
    colours = torch.tensor([[0.58, 0.58, 0.58], [0.41, 0.41, -0.82], [0.71, -0.71, 0.0]])
    planes = [count - 2 * (count // 8), count // 8, count // 8]
    filters = []
    for colour, planned in zip(colours, planes, strict=True):
        for u, v in order[:planned]:
            wave = waves[u][:, None] * waves[v][None, :]
            gain = (1 + u * u + v * v) ** 0.5 / (2 * patch * wave.norm())
            filters.append(colour[:, None, None] * wave * gain)
    return torch.stack(filters)


def wave_positions(side: int, width: int) -> Tensor:
    """Sine and cosine of row and column at several frequencies, [1, side, side, width]."""
    quarter = width // 4
    frequencies = torch.pi * 2.0 ** torch.linspace(-1, 3, quarter)
    angles = torch.arange(side)[:, None] / side * frequencies
    along = torch.cat([angles.sin(), angles.cos()], dim=1)
    rows = along[:, None, :].expand(side, side, 2 * quarter)
    columns = along[None, :, :].expand(side, side, 2 * quarter)
    positions = torch.zeros(1, side, side, width)
    positions[0, :, :, : 4 * quarter] = 0.5 * torch.cat([rows, columns], dim=2)
    return positions
