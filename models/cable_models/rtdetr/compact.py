"""The compact RT-DETR: the published architecture, small enough to ship and to train on a CPU."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from transformers import RTDetrConfig, RTDetrForObjectDetection, RTDetrResNetConfig
from transformers.models.rt_detr.modeling_rt_detr import (
    RTDetrAIFILayer,
    RTDetrCSPRepLayer,
)
from transformers.models.rt_detr.modeling_rt_detr_resnet import RTDetrResNetBasicLayer

CLASS_PRIOR = 0.01


@dataclass(frozen=True, slots=True)
class CompactRtDetrConfig:
    """Size of the network. The defaults are those of the embedded weights."""

    labels: tuple[str, ...] = ("person", "bicycle", "car", "bus", "truck")
    """Class names in the order of the network's outputs; a cyclist is one "bicycle" object."""
    input_size_wh: tuple[int, int] = (512, 288)
    """Width and height that images are resized to, multiples of 32."""
    stem_channels: int = 16
    stage_channels: tuple[int, int, int, int] = (16, 40, 80, 128)
    stage_blocks: tuple[int, int, int, int] = (1, 1, 2, 1)
    width: int = 72
    """Channels of encoder and decoder."""
    queries: int = 64
    decoder_layers: int = 2
    denoising_queries: int = 40


def build_compact_rtdetr(config: CompactRtDetrConfig) -> RTDetrForObjectDetection:
    """A freshly initialised model for training from scratch.

    Args:
        config: Size of the network.

    Returns:
        The transformers model; ``pixel_values`` float32 [N, 3, height, width], RGB in 0..1, to ``logits``
        [N, queries, classes] and ``pred_boxes`` [N, queries, 4] (centre x, centre y, width, height in 0..1).
    """
    model = RTDetrForObjectDetection(transformers_config(config))
    initialise(model)
    return model


def transformers_config(config: CompactRtDetrConfig) -> RTDetrConfig:
    """The same settings in the words of transformers."""
    backbone = RTDetrResNetConfig(  # type: ignore[call-arg]  # out_indices travels through its **kwargs
        embedding_size=config.stem_channels,
        hidden_sizes=list(config.stage_channels),
        depths=list(config.stage_blocks),
        layer_type="basic",
        out_indices=[2, 3, 4],
    )
    settings: Mapping[str, Any] = {
        "backbone_config": backbone,
        "id2label": dict(enumerate(config.labels)),
        "label2id": {name: index for index, name in enumerate(config.labels)},
        "freeze_backbone_batch_norms": False,
        "encoder_hidden_dim": config.width,
        "encoder_in_channels": list(config.stage_channels[1:]),
        "encoder_ffn_dim": 2 * config.width,
        "encoder_attention_heads": 4,
        "hidden_expansion": 0.5,
        "d_model": config.width,
        "num_queries": config.queries,
        "decoder_in_channels": [config.width] * 3,
        "decoder_ffn_dim": 2 * config.width,
        "decoder_attention_heads": 4,
        "decoder_layers": config.decoder_layers,
        "num_denoising": config.denoising_queries,
        "initializer_bias_prior_prob": CLASS_PRIOR,
        # the published weight of 1 leaves scores of small classes behind their boxes for very long
        "weight_loss_vfl": 2.0,
    }
    return RTDetrConfig(**settings)


def initialise(model: RTDetrForObjectDetection) -> None:
    """Replaces the initialisation of transformers, which is meant for loading published weights.

    It draws convolutions, linear layers and batch-norm gains around 0 with deviation 0.01, which lets hardly
    any signal through at first. Class biases (prior 0.01), zeroed box heads and the ring of
    deformable-attention offsets (RT-DETR, Zhao et al. 2023) are kept.
    """
    kept = {id(layer) for layer in head_layers(model)}
    for module in model.modules():
        if id(module) in kept:
            continue
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(module, nn.BatchNorm2d):
            nn.init.ones_(module.weight)
            nn.init.zeros_(module.bias)
        elif isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    for block in model.modules():
        # residual branches start silent: each block is the identity at first
        if isinstance(block, RTDetrResNetBasicLayer):
            nn.init.zeros_(block.layer[-1].get_parameter("normalization.weight"))
    # a zeroed first box layer makes every proposal start as its own anchor
    nn.init.zeros_(model.model.enc_bbox_head.layers[-1].weight)
    nn.init.zeros_(model.model.enc_bbox_head.layers[-1].bias)


def head_layers(model: RTDetrForObjectDetection) -> list[nn.Module]:
    """Layers whose initial values carry meaning: class heads, last box layers, attention offsets."""
    decoder = model.model.decoder
    layers: list[nn.Module] = [model.model.enc_score_head, *decoder.class_embed]
    layers += [head.layers[-1] for head in (model.model.enc_bbox_head, *decoder.bbox_embed)]
    for layer in decoder.layers:
        layers += [layer.encoder_attn.sampling_offsets, layer.encoder_attn.attention_weights]
    return layers


def for_inference(model: RTDetrForObjectDetection, size_wh: tuple[int, int]) -> RTDetrForObjectDetection:
    """A copy with the same answers and fewer operations, for one input size.

    RepVGG blocks become one convolution each (Ding et al., CVPR 2021); anchors and position embedding, which
    only depend on the input size, become constants.

    Args:
        model: Trained model.
        size_wh: Input width and height in pixels, multiples of 32.
    """
    copied = copy.deepcopy(model).train(False)
    for module in copied.modules():
        if isinstance(module, RTDetrCSPRepLayer):
            module.bottlenecks = nn.Sequential(*map(fused_block, module.bottlenecks))
        elif isinstance(module, RTDetrAIFILayer):
            stride = copied.config.feat_strides[-1]
            embedding = FixedPosition(module.position_embedding, size_wh[0] // stride, size_wh[1] // stride)
            module.position_embedding = embedding  # type: ignore[assignment]  # called alike
    detector = copied.model
    detector.config = copy.deepcopy(detector.config)
    detector.config.anchor_image_size = [size_wh[1], size_wh[0]]
    detector.anchors, detector.valid_mask = detector.generate_anchors(device=torch.device("cpu"), dtype=torch.float32)
    return copied


class FixedPosition(nn.Module):
    """The position embedding of one map size."""

    embedding: torch.Tensor

    def __init__(self, source: nn.Module, width: int, height: int) -> None:
        super().__init__()
        values = source(width=width, height=height, device=torch.device("cpu"), dtype=torch.float32)
        self.register_buffer("embedding", values, persistent=False)

    def forward(self, width: int, height: int, device: torch.device | str, dtype: torch.dtype) -> torch.Tensor:
        """float [1, height * width, channels]."""
        return self.embedding.to(device, dtype)


@torch.no_grad()
def fused_block(block: Any) -> nn.Sequential:
    """The 3x3 and the 1x1 branch with their batch norms as one 3x3 convolution, and the activation."""
    kernel, bias = folded(block.conv1)
    point_kernel, point_bias = folded(block.conv2)
    kernel = kernel + nn.functional.pad(point_kernel, (1, 1, 1, 1))
    outputs, inputs = kernel.shape[:2]
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
    convolution.load_state_dict({"weight": kernel, "bias": bias + point_bias})
    return nn.Sequential(convolution, block.activation)


def folded(layer: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Kernel [out, in, h, w] and bias [out] of a convolution with its batch norm in evaluation mode."""
    norm = layer.norm
    gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return layer.conv.weight * gain[:, None, None, None], norm.bias - norm.running_mean * gain


def parameter_count(model: nn.Module) -> int:
    """Number of trainable values."""
    return sum(parameter.numel() for parameter in model.parameters() if parameter.requires_grad)
