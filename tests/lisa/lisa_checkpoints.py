"""Checkpoint folders for the loader's tests: the golden one, copies of it with their tensors changed, other layouts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from cable_models.lisa.architecture import LisaArchitecture
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import SamSizes
from safetensors.torch import load_file, save_file
from transformers import CLIPVisionConfig, LlamaConfig

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden" / "lisa_tiny_a"
needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"the shared data {GOLDEN.name} isn't beside the repo")

Tensors = dict[str, torch.Tensor]


def golden_tensors() -> Tensors:
    """The stored tensors under their original names."""
    return load_file(GOLDEN / "model.safetensors")


def golden_copy(folder: Path, change: Callable[[Tensors], object] | None = None) -> Path:
    """Copy the golden checkpoint, its tensors changed in place by `change`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", "sam_tiny.json", "tokens.json"):
        shutil.copyfile(GOLDEN / name, folder / name)
    tower = folder / "clip_vision_tower"
    tower.mkdir(exist_ok=True)
    for path in (GOLDEN / tower.name).iterdir():
        shutil.copyfile(path, tower / path.name)
    tensors = golden_tensors()
    if change is not None:
        change(tensors)
    save_file(tensors, folder / "model.safetensors")
    return folder


def edit_json(path: Path, **changes: Any) -> None:
    """Set keys of a JSON object; None takes a key away."""
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def write_shards(folder: Path, tensors: Tensors, kind: str) -> None:
    """Replace `model.safetensors` by two interleaved shards and their index, as safetensors or as .bin."""
    (folder / "model.safetensors").unlink()
    stem, suffix = ("model", "safetensors") if kind == "safetensors" else ("pytorch_model", "bin")
    names = sorted(tensors)
    placed: dict[str, str] = {}
    for number, part in enumerate((names[::2], names[1::2]), 1):
        file = f"{stem}-{number:05}-of-00002.{suffix}"
        shard = {name: tensors[name] for name in part}
        save_file(shard, folder / file) if suffix == "safetensors" else torch.save(shard, folder / file)
        placed |= dict.fromkeys(part, file)
    (folder / f"{stem}.{suffix}.index.json").write_text(json.dumps({"metadata": {}, "weight_map": placed}))


def assert_same_weights(one: LisaModel, other: LisaModel) -> None:
    """Bit for bit, the buffers no checkpoint holds included."""
    named = [dict([*model.named_parameters(remove_duplicate=False), *model.named_buffers()]) for model in (one, other)]
    assert named[0].keys() == named[1].keys()
    for name, tensor in named[0].items():
        assert tensor.dtype == named[1][name].dtype, name
        assert torch.equal(tensor, named[1][name]), name


UNLIKE_SAM = SamSizes(
    image_size=96,
    patch_size=8,
    vision_hidden_size=60,
    vision_num_layers=3,
    vision_num_heads=3,
    vision_mlp_dim=56,
    window_size=5,
    global_attn_indexes=(0, 2),
    qkv_bias=False,
    output_channels=48,
    num_pos_feats=24,
    prompt_hidden_size=48,
    mask_input_channels=8,
    num_point_embeddings=4,
    decoder_hidden_size=48,
    decoder_num_layers=3,
    decoder_mlp_dim=40,
    attention_downsample_rate=2,
    num_multimask_outputs=2,
    iou_head_depth=4,
    iou_head_hidden_dim=20,
)
"""Sizes that differ from SAM's and the golden's wherever a loader could have hard-wired one."""


def unlike_architecture() -> LisaArchitecture:
    """LLaVA-1's linear projector, grouped queries, scaled rotary positions, 36 image tokens."""
    llama = LlamaConfig(
        vocab_size=53,
        hidden_size=40,
        intermediate_size=72,
        num_hidden_layers=3,
        num_attention_heads=4,
        num_key_value_heads=2,
        rms_norm_eps=1e-6,
        max_position_embeddings=256,
        rope_parameters={"rope_type": "linear", "factor": 2.0, "rope_theta": 5000.0},
        pad_token_id=None,
    )
    clip = CLIPVisionConfig(
        hidden_size=64, intermediate_size=80, num_hidden_layers=4, num_attention_heads=1, image_size=84, patch_size=14
    )
    return LisaArchitecture(llama, clip, UNLIKE_SAM.config(), "linear", -3, "patch", 48)


def unlike_model(seed: int = 3) -> LisaModel:
    """Random weights of `unlike_architecture`, none of them zero or shared by accident."""
    torch.manual_seed(seed)
    model = LisaModel(unlike_architecture()).eval().requires_grad_(False)
    for parameter in model.parameters():
        parameter.normal_()
    return model
