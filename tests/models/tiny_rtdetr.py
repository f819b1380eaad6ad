"""A small RT-DETR of the published kind (bottleneck blocks), with weights that tell places apart."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import nn
from transformers import RTDetrConfig, RTDetrForObjectDetection, RTDetrResNetConfig

LABELS = ("person", "motorbike", "car", "tree")
SIZE_WH = (96, 64)


def tiny_rtdetr(seed: int = 0) -> RTDetrForObjectDetection:
    torch.manual_seed(seed)
    backbone = RTDetrResNetConfig(
        embedding_size=8, hidden_sizes=[16, 16, 32, 32], depths=[1, 1, 1, 1], layer_type="bottleneck",
        out_indices=[2, 3, 4],
    )  # fmt: skip
    config = RTDetrConfig(
        backbone_config=backbone, id2label=dict(enumerate(LABELS)), label2id={n: i for i, n in enumerate(LABELS)},
        encoder_hidden_dim=16, encoder_in_channels=[16, 32, 32], encoder_ffn_dim=32, encoder_attention_heads=2,
        d_model=16, num_queries=10, decoder_in_channels=[16] * 3, decoder_ffn_dim=32, decoder_attention_heads=2,
        decoder_layers=2, num_denoising=4, initializer_bias_prior_prob=0.3,
    )  # fmt: skip
    model = RTDetrForObjectDetection(config)
    # the library's initial values are for loading others over them: hardly any signal comes through
    for module in model.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.8, 1.2)
            nn.init.normal_(module.bias, 0, 0.2)
            nn.init.normal_(module.running_mean, 0, 0.2)
            nn.init.uniform_(module.running_var, 0.7, 1.4)
        elif isinstance(module, nn.Linear) and float(module.weight.detach().abs().sum()) > 0:
            nn.init.xavier_uniform_(module.weight)
    return model.train(False)


def save_checkpoint(model: nn.Module, folder: Path, processor: dict[str, object] | None = None) -> Path:
    model.save_pretrained(folder)  # type: ignore[operator]
    size = {"size": {"width": SIZE_WH[0], "height": SIZE_WH[1]}}
    (folder / "preprocessor_config.json").write_text(json.dumps({**size, **(processor or {})}))
    return folder
