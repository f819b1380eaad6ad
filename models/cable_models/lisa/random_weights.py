"""Models of stated sizes with random weights: to measure speed and memory where no checkpoint is at hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import nn
from transformers import CLIPVisionConfig, LlamaConfig

from cable_models.lisa.architecture import ClipPreprocessing, LisaArchitecture, square_side
from cable_models.lisa.loader import LoadedLisa, build_empty, materialise_buffers
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import SamSizes
from cable_models.lisa.special_tokens import SpecialTokens

SAM_VIT_H = SamSizes(
    image_size=1024,
    patch_size=16,
    vision_hidden_size=1280,
    vision_num_layers=32,
    vision_num_heads=16,
    vision_mlp_dim=5120,
    window_size=14,
    global_attn_indexes=(7, 15, 23, 31),
    qkv_bias=True,
    output_channels=256,
    num_pos_feats=128,
    prompt_hidden_size=256,
    mask_input_channels=16,
    num_point_embeddings=4,
    decoder_hidden_size=256,
    decoder_num_layers=2,
    decoder_mlp_dim=2048,
    attention_downsample_rate=2,
    num_multimask_outputs=3,
    iou_head_depth=3,
    iou_head_hidden_dim=256,
)


def lisa_7b(clip_size: int = 224) -> LisaArchitecture:
    """Sizes of the published LISA++ 7B.

    Args:
        clip_size: 224 (256 image tokens) or 336 (576).
    """
    return LisaArchitecture(
        llama=llama_config(4096, 11008, 32, 32, 32001),
        clip=clip_config(1024, 24, 16, clip_size),
        sam=SAM_VIT_H.config(),
        projector="mlp2x_gelu",
        select_layer=-2,
        select_feature="patch",
        out_dim=256,
    )


def lisa_small(clip_size: int = 224) -> LisaArchitecture:
    """Sizes for a processor: the published token counts and windows, and shares of the stages near the published ones,
    at about 1/50 of the operations.
    """
    sam = replace(
        SAM_VIT_H,
        vision_hidden_size=256,
        vision_num_layers=8,
        vision_num_heads=4,
        vision_mlp_dim=1024,
        global_attn_indexes=(3, 7),
    )
    return LisaArchitecture(
        llama=llama_config(768, 2064, 12, 12, 2001),
        clip=clip_config(256, 6, 4, clip_size),
        sam=sam.config(),
        projector="mlp2x_gelu",
        select_layer=-2,
        select_feature="patch",
        out_dim=256,
    )


def lisa_tiny(clip_size: int = 56) -> LisaArchitecture:
    """Sizes for tests: a frame takes a few hundredths of a second."""
    sam = replace(
        SAM_VIT_H,
        image_size=256,
        vision_hidden_size=32,
        vision_num_layers=4,
        vision_num_heads=2,
        vision_mlp_dim=64,
        window_size=5,
        global_attn_indexes=(1, 3),
        output_channels=32,
        num_pos_feats=16,
        prompt_hidden_size=32,
        decoder_hidden_size=32,
        decoder_mlp_dim=64,
        iou_head_hidden_dim=32,
    )
    return LisaArchitecture(
        llama=llama_config(64, 128, 2, 4, 101),
        clip=clip_config(48, 3, 4, clip_size),
        sam=sam.config(),
        projector="mlp2x_gelu",
        select_layer=-2,
        select_feature="patch",
        out_dim=32,
    )


def llama_config(width: int, mlp: int, layers: int, heads: int, vocabulary: int) -> LlamaConfig:
    """A Llama without grouped queries, as Vicuna 1.5 7B is one."""
    return LlamaConfig(
        vocab_size=vocabulary,
        hidden_size=width,
        intermediate_size=mlp,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        num_key_value_heads=heads,
        max_position_embeddings=4096,
        rms_norm_eps=1e-5,
        pad_token_id=None,
    )


def clip_config(width: int, layers: int, heads: int, image_size: int) -> CLIPVisionConfig:
    """A CLIP image tower with patches of 14 pixels."""
    return CLIPVisionConfig(
        hidden_size=width,
        intermediate_size=4 * width,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        image_size=image_size,
        patch_size=14,
    )


@torch.no_grad()
def random_lisa(
    architecture: LisaArchitecture,
    *,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
) -> LisaModel:
    """A model whose weights are drawn where they stay, without a copy in the host's memory.

    Matrices are scaled by their fan-in and norms lie near 1, so that activations keep the size they have in a trained
    model; what it says and segments is meaningless.

    Args:
        architecture: Sizes.
        device: Where the weights lie.
        dtype: Their number format.
        seed: The same seed gives the same weights on the same kind of device.
    """
    model = build_empty(architecture)
    generator = torch.Generator(device).manual_seed(seed)
    for module in model.modules():
        for name, empty in list(module.named_parameters(recurse=False)):
            weight = torch.empty(empty.shape, dtype=dtype, device=device)
            setattr(module, name, nn.Parameter(draw(weight, module, name, generator), requires_grad=False))
    model.sam.prompt_encoder.shared_embedding.positional_embedding = (
        model.sam.shared_image_embedding.positional_embedding
    )
    materialise_buffers(model, torch.device(device))
    return model.eval()


def draw(weight: torch.Tensor, module: nn.Module, name: str, generator: torch.Generator) -> torch.Tensor:
    """Fills one parameter in place.

    Args:
        weight: To be filled.
        module: Its owner.
        name: Its name there.
        generator: On the weight's device.
    """
    weight.normal_(generator=generator)
    if weight.ndim == 1:
        return weight.mul_(0.1).add_(1.0) if name == "weight" else weight.mul_(0.02)
    if name in ("pos_embed", "positional_embedding") or isinstance(module, nn.Embedding):
        return weight.mul_(1.0 if name == "positional_embedding" else 0.1)
    return weight.mul_((weight[0].numel()) ** -0.5)


def random_loaded(model: LisaModel) -> LoadedLisa:
    """A random model as the pipeline takes it: the last id of its vocabulary is [SEG], and prompts are given as ids."""
    architecture = model.architecture
    return LoadedLisa(
        model=model,
        architecture=architecture,
        tokens=SpecialTokens(seg=architecture.llama.vocab_size - 1),
        tokenizer=None,
        clip_preprocessing=ClipPreprocessing(square_side(architecture.clip.image_size)),
        folder=Path(),
    )
