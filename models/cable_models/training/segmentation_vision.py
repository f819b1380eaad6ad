"""The vision half of the compact LISA under training: SAM, a dense class head, and one prompt token per concept."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from transformers import SamConfig, SamModel

from cable_models.training.segmentation_encoder import DenseClassHead, encode_rows, initialise, spread_weights
from cable_models.training.segmentation_samples import CLASS_NAMES

CONCEPTS: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("road user", (1, 2, 3)),
    *((name, (index,)) for index, name in enumerate(CLASS_NAMES, start=1)),
)
"""What can be asked for, and the class numbers that it covers."""


@dataclass(frozen=True, slots=True)
class CompactSamConfig:
    """Sizes of the compact SAM; the defaults fit one processor."""

    image_size: int = 384
    patch_size: int = 16
    width: int = 96
    layers: int = 4
    heads: int = 4
    window: int = 8
    """Divides the token grid, and puts the 14 rows of a 16:9 picture into two rows of windows."""
    global_layers: tuple[int, ...] = (1, 3)
    channels: int = 96
    decoder_mlp: int = 192

    def sam_config(self) -> SamConfig:
        """The configuration of transformers' module, with the original's epsilons."""
        return SamConfig(
            vision_config={
                "image_size": self.image_size,
                "patch_size": self.patch_size,
                "hidden_size": self.width,
                "num_hidden_layers": self.layers,
                "num_attention_heads": self.heads,
                "mlp_dim": 4 * self.width,
                "window_size": self.window,
                "global_attn_indexes": list(self.global_layers),
                "output_channels": self.channels,
                "num_pos_feats": self.channels // 2,
            },
            prompt_encoder_config={
                "hidden_size": self.channels,
                "image_size": self.image_size,
                "patch_size": self.patch_size,
            },
            mask_decoder_config={
                "hidden_size": self.channels,
                "mlp_dim": self.decoder_mlp,
                "iou_head_hidden_dim": self.channels,
                "layer_norm_eps": 1e-5,
            },
        )


class VisionTrainee(nn.Module):
    """SAM with what teaches it: a dense head on its encoder and a prompt token per concept."""

    concept_tokens: Tensor

    def __init__(self, config: CompactSamConfig) -> None:
        super().__init__()
        self.config = config
        self.sam = SamModel(config.sam_config())
        self.dense_head = DenseClassHead(config.channels)
        self.register_buffer("concept_tokens", concept_tokens(config.channels))
        initialise(self.sam.vision_encoder)
        spread_weights(self.sam.mask_decoder)
        self.sam.requires_grad_(True)
        for name, parameter in self.sam.named_parameters():
            # Point, box and mask prompts have no part in LISA; random Fourier features stay as drawn.
            unused = name.startswith("prompt_encoder") and "no_mask_embed" not in name
            if unused or "positional_embedding" in name or "rel_pos" in name:
                parameter.requires_grad_(False)

    def features(self, pixels: Tensor) -> Tensor:
        """Image embedding [N, C, rows, columns] of normalised pixels [N, 3, height, image_size]."""
        return encode_rows(self.sam.vision_encoder, pixels)

    def masks(self, features: Tensor, tokens: Tensor) -> Tensor:
        """Mask logits.

        Args:
            features: [N, C, rows, columns].
            tokens: [N, M, C], one prompt token per mask, or [M, C] for the same ones on every picture.

        Returns:
            [N, M, 4 * rows, 4 * columns].
        """
        batch, channels, rows, columns = features.shape
        wide: Tensor = self.sam.get_image_wide_positional_embeddings()  # type: ignore[no-untyped-call]
        positions = wide[:, :, :rows, :columns]
        dense = self.sam.prompt_encoder.no_mask_embed.weight.reshape(1, channels, 1, 1)
        prompts = tokens.expand(batch, -1, channels)[:, :, None, :]
        logits, _ = self.sam.mask_decoder(
            image_embeddings=features,
            image_positional_embeddings=positions.expand(batch, -1, -1, -1),
            sparse_prompt_embeddings=prompts,
            dense_prompt_embeddings=dense.expand_as(features),
            multimask_output=False,
        )
        masks: Tensor = logits[:, :, 0]
        return masks


def concept_tokens(channels: int) -> Tensor:
    """The prompt tokens of all concepts, [len(CONCEPTS), channels]: fixed, so that both halves can be taught apart.

    SAM learns what they stand for, the language side learns to say them. Right-angled, of unit variance.
    """
    drawn = torch.randn(channels, len(CONCEPTS), generator=torch.Generator().manual_seed(7))
    directions: Tensor = torch.linalg.qr(drawn).Q.T
    return directions * channels**0.5


def concept_shares(shares: Tensor) -> Tensor:
    """Share of each concept in a cell, [N, len(CONCEPTS), rows, columns], from the shares of the classes."""
    return torch.stack([shares[:, list(classes)].sum(1) for _, classes in CONCEPTS], dim=1)
