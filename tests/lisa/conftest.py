"""A LISA++ model of a few thousand random weights, made in memory."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from cable_models.lisa.architecture import ClipPreprocessing, LisaArchitecture
from cable_models.lisa.loader import LoadedLisa
from cable_models.lisa.model import LisaModel
from cable_models.lisa.special_tokens import SpecialTokens
from transformers import (
    CLIPVisionConfig,
    LlamaConfig,
    SamConfig,
    SamMaskDecoderConfig,
    SamPromptEncoderConfig,
    SamVisionConfig,
)

VOCABULARY = 60


@pytest.fixture(scope="session")
def tiny_architecture() -> LisaArchitecture:
    """Sizes unlike the published ones in every way that code could have hard-wired."""
    return LisaArchitecture(
        llama=LlamaConfig(
            vocab_size=VOCABULARY,
            hidden_size=48,
            intermediate_size=80,
            num_hidden_layers=3,
            num_attention_heads=4,
            num_key_value_heads=4,
            rms_norm_eps=1e-6,
            pad_token_id=0,
        ),
        clip=CLIPVisionConfig(
            hidden_size=32,
            intermediate_size=64,
            num_hidden_layers=3,
            num_attention_heads=4,
            image_size=70,
            patch_size=14,
        ),
        sam=SamConfig(
            vision_config=SamVisionConfig(
                hidden_size=32,
                num_hidden_layers=3,
                num_attention_heads=4,
                image_size=192,
                window_size=5,
                global_attn_indexes=[2],
                output_channels=32,
                mlp_dim=64,
                num_pos_feats=16,
            ),
            prompt_encoder_config=SamPromptEncoderConfig(hidden_size=32, image_size=192, mask_input_channels=4),
            mask_decoder_config=SamMaskDecoderConfig(
                hidden_size=32, mlp_dim=48, iou_head_hidden_dim=32, layer_norm_eps=1e-5
            ),
        ),
        projector="mlp2x_gelu",
        select_layer=-2,
        select_feature="patch",
        out_dim=32,
    )


@pytest.fixture(scope="session")
def tiny_lisa(tiny_architecture: LisaArchitecture) -> LoadedLisa:
    """The model, every weight drawn large enough to matter."""
    torch.set_num_threads(1)
    torch.manual_seed(7)
    model = LisaModel(tiny_architecture).eval().requires_grad_(False)
    for name, weight in model.named_parameters():
        fan_in = weight[0].numel() if weight.ndim > 1 else 1
        norm_gain = weight.ndim == 1 and name.endswith("weight")
        weight.copy_(torch.randn(weight.shape) * (fan_in**-0.5 if weight.ndim > 1 else 0.1) + float(norm_gain))
    return LoadedLisa(
        model, tiny_architecture, SpecialTokens(seg=VOCABULARY - 1), None, ClipPreprocessing(70), Path("tiny")
    )
