"""The LISA++ network, assembled from the CLIP, Llama and SAM of transformers.

Source: dvlab-research/LISA, branch ``lisa_plus`` (LISA++, arXiv 2312.17240), LLaVA-1.5 variant.
"""

from __future__ import annotations

import torch
from torch import nn
from transformers import CLIPVisionModel, LlamaModel, SamModel

from cable_models.errors import ModelError
from cable_models.lisa.architecture import LisaArchitecture, projector_depth
from cable_models.lisa.compiled import Stacks


class LisaModel(nn.Module):
    """Weights of one LISA++ checkpoint; the stages that use them are functions of their own modules."""

    vision_tower: CLIPVisionModel
    language_model: LlamaModel
    sam: SamModel

    def __init__(self, architecture: LisaArchitecture) -> None:
        super().__init__()
        if architecture.select_feature != "patch":
            raise ModelError(
                f"mm_vision_select_feature '{architecture.select_feature}' is not LISA's; only 'patch' is known"
            )
        self.architecture = architecture
        width = architecture.llama.hidden_size
        self.vision_tower = CLIPVisionModel(architecture.clip)
        self.mm_projector = build_projector(architecture.projector, architecture.clip.hidden_size, width)
        self.language_model = LlamaModel(architecture.llama)
        self.lm_head = nn.Linear(width, architecture.llama.vocab_size, bias=False)
        self.text_hidden_fcs = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, architecture.out_dim))
        self.sam = SamModel(architecture.sam)
        self.stacks = Stacks()

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.lm_head.weight.device

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the language model."""
        return self.lm_head.weight.dtype


def build_projector(kind: str, clip_width: int, width: int) -> nn.Module:
    """From CLIP's width to the language model's: one linear layer (LISA) or an MLP with exact GELU (LLaVA-1.5).

    Args:
        kind: ``linear`` or ``mlpNx_gelu``, as ``mm_projector_type`` of the checkpoint says.
        clip_width: Width of CLIP's hidden states.
        width: Width of the language model.

    Raises:
        ModelError: unknown kind.
    """
    if kind == "linear":
        return nn.Linear(clip_width, width)
    layers: list[nn.Module] = [nn.Linear(clip_width, width)]
    for _ in range(1, projector_depth(kind)):
        layers += [nn.GELU(), nn.Linear(width, width)]
    return nn.Sequential(*layers)
