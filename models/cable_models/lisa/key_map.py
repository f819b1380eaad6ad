"""Names of tensors: those of the original checkpoint against those of `LisaModel`.

Only the direction from the model to the checkpoint is written down; the other is its inverse over the names a model
really has, so that it holds whichever way a version of transformers nests its modules.
"""

from __future__ import annotations

import re
from collections.abc import Collection

from cable_models.errors import ModelError
from cable_models.lisa.sam_sizes import SAM_PREFIX

CLIP_PREFIX = "vision_model."
CLIP_INSIDE = "model.vision_tower.vision_tower."
"""What a tower's names begin with when the checkpoint carries it, before `vision_model.`."""

IGNORED = re.compile(r"model\.layers\.\d+\.self_attn\.rotary_emb\.inv_freq")
"""Tables an old transformers saved; they follow from the configuration."""

_POSITIONAL_MATRIX = "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"
_SAM_RULES = tuple(
    (re.compile(pattern), replacement)
    for pattern, replacement in (
        (r"^(shared_image|prompt_encoder\.shared)_embedding\.positional_embedding$", _POSITIONAL_MATRIX),
        (r"^prompt_encoder\.point_embed\.", "prompt_encoder.point_embeddings."),
        (r"^prompt_encoder\.mask_embed\.conv1\.", "prompt_encoder.mask_downscaling.0."),
        (r"^prompt_encoder\.mask_embed\.layer_norm1\.", "prompt_encoder.mask_downscaling.1."),
        (r"^prompt_encoder\.mask_embed\.conv2\.", "prompt_encoder.mask_downscaling.3."),
        (r"^prompt_encoder\.mask_embed\.layer_norm2\.", "prompt_encoder.mask_downscaling.4."),
        (r"^prompt_encoder\.mask_embed\.conv3\.", "prompt_encoder.mask_downscaling.6."),
        (r"^vision_encoder\.patch_embed\.projection\.", "vision_encoder.patch_embed.proj."),
        (r"^vision_encoder\.layers\.(\d+)\.layer_norm(\d)\.", r"vision_encoder.blocks.\1.norm\2."),
        (r"^vision_encoder\.layers\.", "vision_encoder.blocks."),
        (r"^vision_encoder\.neck\.conv1\.", "vision_encoder.neck.0."),
        (r"^vision_encoder\.neck\.layer_norm1\.", "vision_encoder.neck.1."),
        (r"^vision_encoder\.neck\.conv2\.", "vision_encoder.neck.2."),
        (r"^vision_encoder\.neck\.layer_norm2\.", "vision_encoder.neck.3."),
        (r"^vision_encoder\.", "image_encoder."),
        (r"^mask_decoder\.transformer\.layers\.(\d+)\.layer_norm(\d)\.", r"mask_decoder.transformer.layers.\1.norm\2."),
        (r"\.layer_norm_final_attn\.", ".norm_final_attn."),
        (r"^mask_decoder\.upscale_conv1\.", "mask_decoder.output_upscaling.0."),
        (r"^mask_decoder\.upscale_layer_norm\.", "mask_decoder.output_upscaling.1."),
        (r"^mask_decoder\.upscale_conv2\.", "mask_decoder.output_upscaling.3."),
    )
)
_HEAD = re.compile(
    r"^mask_decoder\.(output_hypernetworks_mlps\.\d+|iou_prediction_head)\.(proj_in|proj_out|layers\.(\d+))\."
)


def original_name(name: str, iou_head_depth: int) -> str:
    """Give the checkpoint's name of one of the model's tensors.

    The image tower, which a checkpoint leaves out, gets the name it has in a folder of its own.

    Args:
        name: A name in `LisaModel.state_dict()`.
        iou_head_depth: Linear layers of the mask decoder's quality head; the original numbers the last one.

    Raises:
        ModelError: `LisaModel` has no such part.
    """
    part, _, rest = name.partition(".")
    match part:
        case "language_model":
            return f"model.{rest}"
        case "lm_head":
            return name
        case "mm_projector":
            return f"model.{name}"
        case "text_hidden_fcs":
            return f"model.text_hidden_fcs.0.{rest}"
        case "vision_tower":
            return CLIP_PREFIX + rest.removeprefix(CLIP_PREFIX)
        case "sam":
            return SAM_PREFIX + _original_sam_name(rest, iou_head_depth)
    raise ModelError(f"{name} belongs to no part of a LISA model")


def names_by_original(names: Collection[str], iou_head_depth: int) -> dict[str, list[str]]:
    """Invert `original_name` over a model's names; SAM's positional matrix serves two of them."""
    inverse: dict[str, list[str]] = {}
    for name in names:
        inverse.setdefault(original_name(name, iou_head_depth), []).append(name)
    return inverse


def _original_sam_name(name: str, iou_head_depth: int) -> str:
    head = _HEAD.match(name)
    if head is not None:
        last = (3 if head[1].startswith("output") else iou_head_depth) - 1
        number = {"proj_in": 0, "proj_out": last}.get(head[2])
        layer = int(head[3]) + 1 if number is None else number
        return f"mask_decoder.{head[1]}.layers.{layer}.{name[head.end() :]}"
    for pattern, replacement in _SAM_RULES:
        name = pattern.sub(replacement, name)
    return name
