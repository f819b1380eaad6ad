"""SAM's image encoder on chosen tokens only, with the weights of an unmodified transformers module.

Source: the image encoder of Segment Anything (Kirillov et al., arXiv 2304.02643; ViTDet windows, decomposed relative
positions of MViTv2, arXiv 2112.01526) as `transformers` implements it. Tokens of all frames stand in one list [n, C];
token-wise layers run on that list, window attention on the windows of all frames packed along the batch dimension,
global attention frame by frame on that frame's tokens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cable_models.errors import ModelError
from cable_models.lisa.sam_plan import SamGrid, SamPlan, TokenLayout

HfModule = Any
"""A module of transformers, whose submodules have no static types."""


@dataclass(frozen=True, slots=True)
class FrameFeatures:
    """The embedding of one frame: a whole map, or the computed tokens of it."""

    values: Tensor
    """[C, side, side] of a whole frame, else [n, C]."""
    indexes: Tensor | None = None
    """int64 [n], row * side + column of each token; None for a whole map."""


@dataclass(frozen=True, slots=True)
class SamFeatures:
    """Embeddings of a batch of frames, in the order of the batch."""

    frames: tuple[FrameFeatures, ...]
    side: int
    """Tokens along one side of the whole map."""


@dataclass(frozen=True, slots=True)
class PackedTokens:
    """Where the listed tokens of several frames lie; int64 tensors [n] on the encoder's device."""

    frames: Tensor
    rows: Tensor
    columns: Tensor
    slots: Tensor
    """Place in the packed windows, window by window."""
    hidden: Tensor | None
    """bool [w, 1, 1, window ** 2], places that attention must not see; None where there are none."""
    windows: int
    """Packed windows w of all frames together."""
    counts: list[int]
    """Tokens of each frame."""


def encode(
    vision_encoder: HfModule,
    pixels: Tensor,
    plans: Sequence[SamPlan | None] | None = None,
    *,
    run_whole: Callable[[HfModule, Tensor], Tensor] | None = None,
    run_block: Callable[..., Tensor] | None = None,
) -> SamFeatures:
    """Encodes frames, each whole or in part.

    Frames that are whole go through the unmodified module, in one batch. In the other frames, windows that are computed
    whole are exact up to the first global block; there and after, attention sees the computed tokens only. The
    3 x 3 convolution of the neck sees, in place of a neighbour that wasn't computed, the token itself; tokens with all
    eight neighbours computed are convolved exactly.

    Args:
        vision_encoder: ``SamModel.vision_encoder``.
        pixels: [B, 3, S, S], normalised and padded, in the encoder's dtype.
        plans: One per frame, None for a whole frame; None for whole frames only.
        run_whole: Runs the encoder on whole frames; None = its own forward.
        run_block: Stands in for `run_layer`, a compiled one for example.

    Raises:
        ModelError: shapes or plans that don't fit the encoder.
    """
    grid = grid_of(vision_encoder)
    check_batch(grid, pixels, plans)
    partial = {i: plan for i, plan in enumerate(plans or ()) if plan is not None and not plan.whole}
    whole = [i for i in range(len(pixels)) if i not in partial]
    found: dict[int, FrameFeatures] = {}
    if whole:
        chosen = pixels if not partial else pixels[whole]
        maps = vision_encoder(chosen)[0] if run_whole is None else run_whole(vision_encoder, chosen)
        found.update((i, FrameFeatures(values)) for i, values in zip(whole, maps, strict=True))
    if partial:
        found.update(zip(partial, encode_tokens(vision_encoder, pixels, partial, run_block), strict=True))
    return SamFeatures(tuple(found[i] for i in range(len(pixels))), grid.side)


def grid_of(vision_encoder: HfModule) -> SamGrid:
    """The sizes that `plan_sam` needs, read from a module's configuration."""
    config = vision_encoder.config
    return SamGrid(int(config.image_size), int(config.patch_size), int(config.window_size))


def check_batch(grid: SamGrid, pixels: Tensor, plans: Sequence[SamPlan | None] | None) -> None:
    """Refuses pixels or plans that don't fit the encoder.

    Raises:
        ModelError: as said.
    """
    if pixels.ndim != 4 or pixels.shape[1:] != (3, grid.image_size, grid.image_size):
        raise ModelError(f"SAM takes pixels [B, 3, {grid.image_size}, {grid.image_size}], got {list(pixels.shape)}")
    if plans is not None and len(plans) != len(pixels):
        raise ModelError(f"{len(plans)} SAM plans were given for {len(pixels)} frames")
    if any(plan is not None and plan.grid != grid for plan in plans or ()):
        raise ModelError(f"a SAM plan was made for other sizes than this encoder's {grid}; plan with grid_of(encoder)")


def encode_tokens(
    encoder: HfModule,
    pixels: Tensor,
    plans: Mapping[int, SamPlan],
    run_block: Callable[..., Tensor] | None = None,
) -> list[FrameFeatures]:
    """Encodes the planned tokens of the frames ``pixels[i]``, for every i of ``plans``, in that order."""
    layouts = [(frame, plan.layout()) for frame, plan in plans.items()]
    packed, side = pack(layouts, pixels.device), grid_of(encoder).side
    if not len(packed.rows):
        nothing = pixels.new_zeros(0, encoder.config.output_channels)
        return [FrameFeatures(nothing, packed.rows) for _ in plans]
    hidden = embed_patches(encoder, pixels, packed)
    for layer in encoder.layers:
        hidden = (run_block or run_layer)(layer, hidden, packed)
    values = run_neck(encoder.neck, hidden, neighbour_indexes(layouts, side).to(pixels.device))
    indexes = torch.split(packed.rows * side + packed.columns, packed.counts)
    return [FrameFeatures(*part) for part in zip(torch.split(values, packed.counts), indexes, strict=True)]


def pack(layouts: Sequence[tuple[int, TokenLayout]], device: torch.device) -> PackedTokens:
    """Lists the tokens of several frames one frame after the other.

    Args:
        layouts: (number of the frame in its batch, its tokens).
        device: Where the encoder runs.
    """
    hidden = np.concatenate([layout.hidden for _, layout in layouts])
    area, before, columns = hidden.shape[1], 0, []
    for frame, layout in layouts:
        listed = (np.full(len(layout.rows), frame), layout.rows, layout.columns, layout.slots + before * area)
        columns.append(np.stack(listed))
        before += len(layout.hidden)
    on_device = torch.from_numpy(np.concatenate(columns, axis=1)).to(device)
    return PackedTokens(
        frames=on_device[0],
        rows=on_device[1],
        columns=on_device[2],
        slots=on_device[3],
        hidden=torch.from_numpy(hidden).to(device)[:, None, None, :] if hidden.any() else None,
        windows=len(hidden),
        counts=[len(layout.rows) for _, layout in layouts],
    )


def embed_patches(encoder: HfModule, pixels: Tensor, packed: PackedTokens) -> Tensor:
    """The patch convolution, whose stride is its kernel, as a product over the listed patches; [n, C]."""
    projection, positions = encoder.patch_embed.projection, encoder.pos_embed
    batch, channels, size, _ = pixels.shape
    patch = projection.kernel_size[0]
    cut = pixels.reshape(batch, channels, size // patch, patch, size // patch, patch).permute(0, 2, 4, 1, 3, 5)
    patches = cut[packed.frames, packed.rows, packed.columns].flatten(1)
    hidden = functional.linear(patches, projection.weight.flatten(1), projection.bias)
    return hidden if positions is None else hidden + positions[0, packed.rows, packed.columns]


def run_layer(layer: HfModule, hidden: Tensor, packed: PackedTokens) -> Tensor:
    """One transformer block on the listed tokens [n, C]."""
    attention, window = layer.attn, int(layer.window_size)
    qkv = attention.qkv(layer.layer_norm1(hidden))
    if window:
        mixed = attend_in_windows(attention, qkv, packed, window)
    else:
        parts = zip(*(torch.split(each, packed.counts) for each in (qkv, packed.rows, packed.columns)), strict=True)
        mixed = torch.cat([attend_globally(attention, *part) for part in parts])
    hidden = hidden + attention.proj(mixed)
    return hidden + layer.mlp(layer.layer_norm2(hidden))


def attend_in_windows(attention: HfModule, qkv: Tensor, packed: PackedTokens, window: int) -> Tensor:
    """Attention within each packed window.

    Where a window hangs over the token grid the original network attends to zero vectors, whose query, key and value
    are the bias of the projection; they stay. Tokens inside the grid that aren't computed are masked.

    Args:
        attention: The block's attention module.
        qkv: [n, 3 C], projected tokens.
        packed: Their places.
        window: Side of a window in tokens.

    Returns:
        [n, C].
    """
    area, heads = window**2, int(attention.num_attention_heads)
    if len(qkv) < packed.windows * area:
        blank = qkv.new_zeros(qkv.shape[1]) if attention.qkv.bias is None else attention.qkv.bias.to(qkv.dtype)
        filled = blank.repeat(packed.windows * area, 1).index_copy_(0, packed.slots, qkv)
    else:
        filled = qkv
    query, key, value = filled.view(packed.windows, area, 3, heads, -1).permute(2, 0, 3, 1, 4).unbind(0)
    bias = window_bias(attention, query, window)
    if packed.hidden is not None:
        bias = ~packed.hidden if bias is None else bias.masked_fill_(packed.hidden, float("-inf"))
    mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=bias)
    mixed = mixed.transpose(1, 2).reshape(packed.windows * area, -1)
    return mixed if filled is qkv else mixed[packed.slots]


def window_bias(attention: HfModule, query: Tensor, window: int) -> Tensor | None:
    """Relative-position term of whole windows: query [w, heads, a, d] to [w, heads, a, a] where a = window ** 2."""
    if not attention.use_rel_pos:
        return None
    places = torch.arange(window, device=query.device)
    offsets = places[:, None] - places + window - 1
    cut = query.reshape(*query.shape[:2], window, window, -1)
    by_row = torch.einsum("whrcd,rkd->whrck", cut, attention.rel_pos_h[offsets])
    by_column = torch.einsum("whrcd,ckd->whrck", cut, attention.rel_pos_w[offsets])
    return (by_row[..., :, None] + by_column[..., None, :]).flatten(4, 5).flatten(2, 3)


def attend_globally(attention: HfModule, qkv: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Attention among all listed tokens of one frame.

    Args:
        attention: The block's attention module.
        qkv: [n, 3 C], projected tokens of the frame.
        rows: int64 [n], their rows in the whole grid.
        columns: int64 [n].

    Returns:
        [n, C].
    """
    if not len(qkv):
        return qkv.new_zeros(0, qkv.shape[1] // 3)
    query, key, value = qkv.view(len(qkv), 3, int(attention.num_attention_heads), -1).permute(1, 2, 0, 3).unbind(0)
    bias = None
    if attention.use_rel_pos:
        # The offsets are those of the whole grid: tables resized to a smaller one would shift every position.
        bias = axis_bias(query, attention.rel_pos_h, rows)
        bias += axis_bias(query, attention.rel_pos_w, columns)
        bias = bias[None]
    mixed = functional.scaled_dot_product_attention(query[None], key[None], value[None], attn_mask=bias)
    return mixed[0].transpose(0, 1).flatten(1)


def axis_bias(query: Tensor, table: Tensor, positions: Tensor) -> Tensor:
    """Relative-position term of one axis between listed tokens.

    Args:
        query: [heads, n, d].
        table: [2 side - 1, d], row ``i - j + side - 1`` for a query at i and a key at j.
        positions: int64 [n], row or column of each token in the whole grid.

    Returns:
        [heads, n, n]: ``query[i] . table[positions[i] - positions[j] + side - 1]``.
    """
    side = (len(table) + 1) // 2
    offsets = positions[:, None] - torch.arange(side, device=positions.device) + side - 1
    to_every_line = (query @ table.T).gather(2, offsets.expand(len(query), -1, -1))
    return to_every_line[..., positions]


def neighbour_indexes(layouts: Sequence[tuple[int, TokenLayout]], side: int) -> Tensor:
    """Number, in the token list, of each token's 3 x 3 neighbours.

    A neighbour that wasn't computed is replaced by the token itself, one outside the grid by number -1 (the zero
    padding of the convolution).

    Args:
        layouts: Of the frames, in the order of the list.
        side: Tokens along one side of the grid.

    Returns:
        int64 [n, 9], neighbours row by row.
    """
    tables, listed = [], 0
    for _, layout in layouts:
        own = np.arange(listed, listed + len(layout.rows))
        numbers = np.full((side + 2, side + 2), -1)
        numbers[1:-1, 1:-1] = -2
        numbers[layout.rows + 1, layout.columns + 1] = own
        around = np.lib.stride_tricks.sliding_window_view(numbers, (3, 3))[layout.rows, layout.columns].reshape(-1, 9)
        tables.append(np.where(around == -2, own[:, None], around))
        listed += len(own)
    return torch.from_numpy(np.concatenate(tables))


def run_neck(neck: HfModule, hidden: Tensor, neighbours: Tensor) -> Tensor:
    """The two convolutions of the neck as products over listed tokens, [n, C] to [n, output channels].

    Args:
        neck: The module.
        hidden: [n, C].
        neighbours: int64 [n, 9] of `neighbour_indexes`, on the same device.
    """
    narrow = normalise(neck.layer_norm1, functional.linear(hidden, neck.conv1.weight.flatten(1)))
    with_zero = torch.cat([narrow, narrow.new_zeros(1, narrow.shape[1])])
    around = with_zero[neighbours].flatten(1)
    weight = neck.conv2.weight.permute(0, 2, 3, 1).flatten(1)
    return normalise(neck.layer_norm2, functional.linear(around, weight))


def normalise(norm: HfModule, values: Tensor) -> Tensor:
    """A channels-first layer norm of the neck on channels-last values [n, C]."""
    return functional.layer_norm(values, norm.normalized_shape, norm.weight, norm.bias, norm.eps)
