"""Sizes of the SAM inside a LISA++ checkpoint, read off its tensors: config.json says nothing of them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from transformers import SamConfig

from cable_models.errors import ModelError
from cable_models.lisa.images import SAM_MEAN, SAM_STD

SAM_PREFIX = "model.visual_model."

Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class SamSizes:
    """Sizes of a SAM; the names are those of the sidecar file `sam*.json`, lengths in pixels, tokens or channels."""

    image_size: int
    patch_size: int
    vision_hidden_size: int
    vision_num_layers: int
    vision_num_heads: int
    vision_mlp_dim: int
    window_size: int
    global_attn_indexes: tuple[int, ...]
    qkv_bias: bool
    output_channels: int
    num_pos_feats: int
    prompt_hidden_size: int
    mask_input_channels: int
    num_point_embeddings: int
    decoder_hidden_size: int
    decoder_num_layers: int
    decoder_mlp_dim: int
    attention_downsample_rate: int
    num_multimask_outputs: int
    iou_head_depth: int
    iou_head_hidden_dim: int
    decoder_num_heads: int = 8
    vision_layer_norm_eps: float = 1e-6
    decoder_activation_mlp: str = "relu"

    def config(self) -> SamConfig:
        """Build the configuration of the transformers module.

        The original mask decoder's layer norms have epsilon 1e-5, unlike the module's default.
        """
        return SamConfig(
            vision_config={
                "image_size": self.image_size,
                "patch_size": self.patch_size,
                "hidden_size": self.vision_hidden_size,
                "num_hidden_layers": self.vision_num_layers,
                "num_attention_heads": self.vision_num_heads,
                "mlp_dim": self.vision_mlp_dim,
                "window_size": self.window_size,
                "global_attn_indexes": list(self.global_attn_indexes),
                "qkv_bias": self.qkv_bias,
                "output_channels": self.output_channels,
                "num_pos_feats": self.num_pos_feats,
                "layer_norm_eps": self.vision_layer_norm_eps,
                "hidden_act": "gelu",
            },
            prompt_encoder_config={
                "hidden_size": self.prompt_hidden_size,
                "image_size": self.image_size,
                "patch_size": self.patch_size,
                "mask_input_channels": self.mask_input_channels,
                "num_point_embeddings": self.num_point_embeddings,
                "layer_norm_eps": 1e-6,
            },
            mask_decoder_config={
                "hidden_size": self.decoder_hidden_size,
                "num_hidden_layers": self.decoder_num_layers,
                "num_attention_heads": self.decoder_num_heads,
                "mlp_dim": self.decoder_mlp_dim,
                "attention_downsample_rate": self.attention_downsample_rate,
                "num_multimask_outputs": self.num_multimask_outputs,
                "iou_head_depth": self.iou_head_depth,
                "iou_head_hidden_dim": self.iou_head_hidden_dim,
                "layer_norm_eps": 1e-5,
                "hidden_act": self.decoder_activation_mlp,
            },
        )


def sam_sizes_of(config: SamConfig) -> SamSizes:
    """Read the sizes back from a module's configuration, the inverse of `SamSizes.config`."""
    vision: Any = config.vision_config
    prompt: Any = config.prompt_encoder_config
    decoder: Any = config.mask_decoder_config
    return SamSizes(
        image_size=vision.image_size,
        patch_size=vision.patch_size,
        vision_hidden_size=vision.hidden_size,
        vision_num_layers=vision.num_hidden_layers,
        vision_num_heads=vision.num_attention_heads,
        vision_mlp_dim=vision.mlp_dim,
        window_size=vision.window_size,
        global_attn_indexes=tuple(vision.global_attn_indexes),
        qkv_bias=vision.qkv_bias,
        output_channels=vision.output_channels,
        num_pos_feats=vision.num_pos_feats,
        prompt_hidden_size=prompt.hidden_size,
        mask_input_channels=prompt.mask_input_channels,
        num_point_embeddings=prompt.num_point_embeddings,
        decoder_hidden_size=decoder.hidden_size,
        decoder_num_layers=decoder.num_hidden_layers,
        decoder_mlp_dim=decoder.mlp_dim,
        attention_downsample_rate=decoder.attention_downsample_rate,
        num_multimask_outputs=decoder.num_multimask_outputs,
        iou_head_depth=decoder.iou_head_depth,
        iou_head_hidden_dim=decoder.iou_head_hidden_dim,
        decoder_num_heads=decoder.num_attention_heads,
        vision_layer_norm_eps=vision.layer_norm_eps,
        decoder_activation_mlp=decoder.hidden_act,
    )


def read_sam_sizes(shapes: Shapes, sidecar: Mapping[str, Any] | None = None) -> SamSizes:
    """Infer a SAM's sizes from its tensors.

    Only three things leave no trace in the shapes: the mask decoder's head count (8 in every published SAM), the
    encoder's layer norm epsilon and the decoder's activation. They come from the sidecar, else they are SAM's.

    Args:
        shapes: Shapes of the checkpoint's tensors under their original names.
        sidecar: Content of the `sam*.json` beside the checkpoint; names it doesn't share with `SamSizes` are ignored,
            but for the pixel statistics and the use of position tables, which must be SAM's own.

    Raises:
        ModelError: A tensor is missing or has an impossible shape, or the sidecar contradicts the tensors.
    """
    sam = {name[len(SAM_PREFIX) :]: shape for name, shape in shapes.items() if name.startswith(SAM_PREFIX)}
    if not sam:
        raise ModelError(
            f"the checkpoint holds no SAM: not one tensor begins with {SAM_PREFIX}; it was saved before merging, "
            "or it is a plain LLaVA"
        )
    inferred = SamSizes(**_encoder_sizes(sam), **_prompt_sizes(sam), **_decoder_sizes(sam))
    sizes = inferred if sidecar is None else _with_sidecar(inferred, sidecar)
    internal = sizes.decoder_hidden_size // sizes.attention_downsample_rate
    if internal % sizes.decoder_num_heads:
        raise ModelError(
            f"SAM: {sizes.decoder_num_heads} heads don't divide the mask decoder's {internal} attention channels; "
            "give decoder_num_heads in a sam.json beside config.json"
        )
    return sizes


def _encoder_sizes(sam: Shapes) -> dict[str, Any]:
    hidden, _, patch, _ = _shape(sam, "image_encoder.patch_embed.proj.weight", 4)
    _, grid, columns, _ = _shape(sam, "image_encoder.pos_embed", 4)
    if grid != columns:
        raise ModelError(f"SAM: the position table covers {grid}x{columns} tokens; only squares are known")
    layers = _count(sam, r"image_encoder\.blocks\.(\d+)\.")
    tables = [_shape(sam, f"image_encoder.blocks.{n}.attn.rel_pos_h", 2) for n in range(layers)]
    head = tables[0][1]
    if not head or hidden % head:
        raise ModelError(f"SAM: relative positions of {head} channels don't divide a width of {hidden}")
    windowed = {rows for rows, _ in tables if rows != 2 * grid - 1}
    if len(windowed) > 1:
        raise ModelError(f"SAM: rel_pos_h tables of {sorted(windowed)} rows belong to windows of different sizes")
    return {
        "image_size": grid * patch,
        "patch_size": patch,
        "vision_hidden_size": hidden,
        "vision_num_layers": layers,
        "vision_num_heads": hidden // head,
        "vision_mlp_dim": _shape(sam, "image_encoder.blocks.0.mlp.lin1.weight", 2)[0],
        "window_size": (windowed.pop() + 1) // 2 if windowed else grid,
        "global_attn_indexes": tuple(n for n, (rows, _) in enumerate(tables) if rows == 2 * grid - 1),
        "qkv_bias": "image_encoder.blocks.0.attn.qkv.bias" in sam,
        "output_channels": _shape(sam, "image_encoder.neck.0.weight", 4)[0],
    }


def _prompt_sizes(sam: Shapes) -> dict[str, Any]:
    return {
        "num_pos_feats": _shape(sam, "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix", 2)[1],
        "prompt_hidden_size": _shape(sam, "prompt_encoder.no_mask_embed.weight", 2)[1],
        "mask_input_channels": _shape(sam, "prompt_encoder.mask_downscaling.3.weight", 4)[0],
        "num_point_embeddings": _count(sam, r"prompt_encoder\.point_embeddings\.(\d+)\.weight"),
    }


def _decoder_sizes(sam: Shapes) -> dict[str, Any]:
    masks, hidden = _shape(sam, "mask_decoder.mask_tokens.weight", 2)
    transformer = "mask_decoder.transformer."
    internal = _shape(sam, f"{transformer}final_attn_token_to_image.q_proj.weight", 2)[0]
    if hidden != 2 * internal:
        # The blocks of transformers' mask decoder halve whatever their configuration says.
        raise ModelError(f"SAM: cross attention of {internal} channels isn't half of a decoder width of {hidden}")
    return {
        "decoder_hidden_size": hidden,
        "decoder_num_layers": _count(sam, r"mask_decoder\.transformer\.layers\.(\d+)\."),
        "decoder_mlp_dim": _shape(sam, f"{transformer}layers.0.mlp.lin1.weight", 2)[0],
        "attention_downsample_rate": 2,
        "num_multimask_outputs": masks - 1,
        "iou_head_depth": _count(sam, r"mask_decoder\.iou_prediction_head\.layers\.(\d+)\.weight"),
        "iou_head_hidden_dim": _shape(sam, "mask_decoder.iou_prediction_head.layers.0.weight", 2)[0],
    }


def _with_sidecar(inferred: SamSizes, sidecar: Mapping[str, Any]) -> SamSizes:
    given = {field.name: sidecar[field.name] for field in fields(SamSizes) if field.name in sidecar}
    if "global_attn_indexes" in given:
        given["global_attn_indexes"] = tuple(given["global_attn_indexes"])
    free = {"decoder_num_heads", "vision_layer_norm_eps", "decoder_activation_mlp"}
    # A window as large as the grid leaves the same tables as global attention, and so does a SAM without windows.
    if len(inferred.global_attn_indexes) == inferred.vision_num_layers:
        free |= {"window_size", "global_attn_indexes"}
    wrong = {
        name: (value, getattr(inferred, name))
        for name, value in given.items()
        if name not in free and value != getattr(inferred, name)
    }
    fixed = {"pixel_mean": list(SAM_MEAN), "pixel_std": list(SAM_STD), "use_rel_pos": True, "use_abs_pos": True}
    wrong |= {name: (sidecar[name], value) for name, value in fixed.items() if sidecar.get(name, value) != value}
    if wrong:
        told = "; ".join(f"{name}: {said!r} in the sidecar, {seen!r} here" for name, (said, seen) in wrong.items())
        raise ModelError(f"the SAM sidecar file contradicts the checkpoint's tensors: {told}")
    return replace(inferred, **given)


def _shape(shapes: Shapes, name: str, dimensions: int) -> tuple[int, ...]:
    shape = shapes.get(name)
    if shape is None:
        raise ModelError(f"the checkpoint has no {SAM_PREFIX}{name}, which gives SAM's sizes")
    if len(shape) != dimensions or 0 in shape:
        raise ModelError(f"{SAM_PREFIX}{name} has the shape {list(shape)}; {dimensions} dimensions were expected")
    return shape


def _count(shapes: Shapes, pattern: str) -> int:
    found = {int(match[1]) for name in shapes if (match := re.match(pattern, name))}
    if not found:
        raise ModelError(f"the checkpoint has no tensor like {SAM_PREFIX}{pattern}, which gives SAM's sizes")
    return max(found) + 1
