"""From SAM's image embedding and [SEG] embeddings to mask logits at the frame's size.

Each [SEG] is one prompt of one sparse token, its embedding as it is, with the "no mask" dense embedding; single-mask
output (dvlab-research/LISA, branch lisa_plus). The unmodified `SamMaskDecoder` of transformers does the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers import SamModel

from cable_models.errors import ModelError
from cable_models.lisa.images import Size
from cable_models.lisa.sam_encoder import FrameFeatures, SamFeatures

OUTSIDE_LOGIT = -32.0
"""Logit of what wasn't decoded: no mask, with certainty, yet small enough for any float format."""
PIXELS_PER_TOKEN = 4
"""Side of one token in the low-resolution mask."""
PROMPTS_AT_ONCE = 32
"""Most prompts per pass over whole maps; each takes some 50 MB at SAM's sizes in float32."""

# A straight border copies the pixel across it; only a corner pixel has nothing but a diagonal neighbour.
_NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))

_positions: WeakKeyDictionary[nn.Module, tuple[object, Tensor]] = WeakKeyDictionary()


def decode_masks(sam: SamModel, features: SamFeatures, prompts: Sequence[Tensor]) -> list[Tensor]:
    """Decodes the masks of a batch of frames.

    A frame encoded in part is decoded from its computed tokens alone, shown to the decoder as an image one token
    wide: its transformer takes a set of tokens with positions, and its two upscaling convolutions have a stride equal
    to their kernel, so that a token's 4 x 4 pixels depend on no other token. Pixels without a token are
    `OUTSIDE_LOGIT`, save that the computed region is continued by one pixel: the bilinear enlargement that follows
    then has the region's own value beyond its border and doesn't erode a mask that reaches it.

    Args:
        sam: The module whose mask decoder and prompt embeddings are used.
        features: Of `encode`, B frames.
        prompts: B tensors [n_seg, C] of [SEG] embeddings, n_seg may differ and be 0.

    Returns:
        B tensors [n_seg, 4 side, 4 side] of logits, in the decoder's dtype.

    Raises:
        ModelError: prompts that don't fit the frames or the decoder.
    """
    width = sam.mask_decoder.hidden_size
    if len(prompts) != len(features.frames) or any(p.ndim != 2 or p.shape[1] != width for p in prompts):
        shapes = [list(prompt.shape) for prompt in prompts]
        raise ModelError(f"{len(features.frames)} frames need as many prompts [n_seg, {width}], got {shapes}")
    decoded: list[Tensor | None] = [None] * len(prompts)
    whole = [i for i, frame in enumerate(features.frames) if frame.indexes is None and len(prompts[i])]
    for i, masks in zip(whole, decode_whole(sam, features, prompts, whole), strict=True):
        decoded[i] = masks
    return [
        decode_part(sam, frame, prompt, features.side) if masks is None else masks
        for masks, frame, prompt in zip(decoded, features.frames, prompts, strict=True)
    ]


def decode_whole(
    sam: SamModel, features: SamFeatures, prompts: Sequence[Tensor], frames: Sequence[int]
) -> Sequence[Tensor]:
    """Decodes the frames numbered, whose maps are whole; their prompts share passes."""
    if not frames:
        return []
    counts = [len(prompts[i]) for i in frames]
    listed = torch.cat([prompts[i] for i in frames])
    maps = [features.frames[i].values for i, count in zip(frames, counts, strict=True) for _ in range(count)]
    positions = dense_positional_embedding(sam)
    masks = [
        run_decoder(sam, torch.stack(maps[first : first + PROMPTS_AT_ONCE]), positions, prompt)
        for first, prompt in zip(
            range(0, len(maps), PROMPTS_AT_ONCE), torch.split(listed, PROMPTS_AT_ONCE), strict=True
        )
    ]
    return torch.split(torch.cat(masks), counts)


def decode_part(sam: SamModel, frame: FrameFeatures, prompts: Tensor, side: int) -> Tensor:
    """Decodes one frame from its listed tokens, `decode_masks` says how."""
    pixels = PIXELS_PER_TOKEN * side
    shape = (len(prompts), side * side, PIXELS_PER_TOKEN, PIXELS_PER_TOKEN)
    dtype = sam.mask_decoder.iou_token.weight.dtype
    outside = torch.full(shape, OUTSIDE_LOGIT, dtype=dtype, device=prompts.device)
    if frame.indexes is None or not outside.numel() or not len(frame.values):
        return outside.view(len(prompts), pixels, pixels)
    positions = dense_positional_embedding(sam).flatten(2)[:, :, frame.indexes, None]
    image = frame.values.T[None, :, :, None].expand(len(prompts), -1, -1, -1)
    strips = run_decoder(sam, image, positions, prompts)
    computed = strips.reshape(len(prompts), -1, PIXELS_PER_TOKEN, PIXELS_PER_TOKEN)
    tokens = outside.index_copy(1, frame.indexes, computed)
    kept = torch.zeros(side * side, dtype=torch.bool, device=image.device).index_fill_(0, frame.indexes, True)
    low_res = tokens.view(len(prompts), side, side, PIXELS_PER_TOKEN, PIXELS_PER_TOKEN).transpose(2, 3)
    kept_pixels = kept.view(side, side).repeat_interleave(PIXELS_PER_TOKEN, 0).repeat_interleave(PIXELS_PER_TOKEN, 1)
    return continue_border(low_res.reshape(len(prompts), pixels, pixels), kept_pixels)


def run_decoder(sam: SamModel, images: Tensor, positions: Tensor, prompts: Tensor) -> Tensor:
    """One pass of the unmodified mask decoder.

    Args:
        sam: The module.
        images: [n, C, rows, columns], an embedding per prompt.
        positions: [1, C, rows, columns].
        prompts: [n, C].

    Returns:
        [n, 4 rows, 4 columns].
    """
    decoder = sam.mask_decoder
    dtype = decoder.iou_token.weight.dtype
    masks = decoder(
        image_embeddings=images.to(dtype),
        image_positional_embeddings=positions.to(dtype).expand(len(prompts), -1, -1, -1),
        sparse_prompt_embeddings=prompts[:, None, None].to(dtype),
        dense_prompt_embeddings=sam.prompt_encoder.no_mask_embed.weight.to(dtype).reshape(1, -1, 1, 1),
        multimask_output=False,
    )[0]
    return masks[:, 0, 0]


def dense_positional_embedding(sam: SamModel) -> Tensor:
    """Positional encoding of every token of the map, [1, C, side, side], in the device and dtype of the module.

    It's computed once for as long as the module's weights stay as they are.
    """
    weight = sam.shared_image_embedding.positional_embedding
    state = (weight.data_ptr(), weight.device, weight.dtype, None if weight.is_inference() else weight._version)
    known, positions = _positions.get(sam, (None, weight))
    if known != state:
        with torch.inference_mode(False), torch.no_grad():
            positions = sam.get_image_wide_positional_embeddings()  # type: ignore[no-untyped-call]
        _positions[sam] = (state, positions)
    return positions


def continue_border(low_res: Tensor, kept: Tensor) -> Tensor:
    """Copies the values at the border of the kept region one pixel outwards.

    Args:
        low_res: [n, rows, columns].
        kept: bool [rows, columns].
    """
    rows, columns = kept.shape
    framed, framed_kept = functional.pad(low_res, (1, 1, 1, 1)), functional.pad(kept, (1, 1, 1, 1))
    continued, known = low_res, kept
    for down, right in _NEIGHBOURS:
        area = (..., slice(1 + down, 1 + down + rows), slice(1 + right, 1 + right + columns))
        continued = torch.where(framed_kept[area] & ~known, framed[area], continued)
        known = known | framed_kept[area]
    return continued


def upsample_logits(low_res: Tensor, resized_hw: Size, frame_hw: Size, image_size: int) -> Tensor:
    """Enlarges low-resolution logits to the frame, with the original's two bilinear steps.

    Args:
        low_res: [n, rows, columns] or [n, 1, rows, columns], any float dtype.
        resized_hw: (h, w) of the picture in SAM's input.
        frame_hw: (H, W) of the frame.
        image_size: Side of SAM's input.

    Returns:
        float32 [n, H, W].

    Raises:
        ModelError: wrong number of dimensions.
    """
    if low_res.ndim not in (3, 4) or (low_res.ndim == 4 and low_res.shape[1] != 1):
        raise ModelError(f"low-resolution logits must be [n, rows, columns], got {list(low_res.shape)}")
    logits = low_res.float().reshape(-1, 1, *low_res.shape[-2:])
    if not len(logits):
        return logits.new_zeros(0, *frame_hw)
    height, width = resized_hw
    square = functional.interpolate(logits, (image_size, image_size), mode="bilinear", align_corners=False)
    return functional.interpolate(square[..., :height, :width], frame_hw, mode="bilinear", align_corners=False)[:, 0]
