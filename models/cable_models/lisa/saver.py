"""Saving a LISA++ model in the layout of the original checkpoints, so that it loads like one."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from cable_models.errors import ModelError
from cable_models.lisa.architecture import ClipPreprocessing, LisaArchitecture, square_side
from cable_models.lisa.images import SAM_MEAN, SAM_STD
from cable_models.lisa.json_files import write_json
from cable_models.lisa.key_map import CLIP_PREFIX, names_by_original
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import sam_sizes_of
from cable_models.lisa.special_tokens import SpecialTokens

CLIP_FOLDER = "clip_vision_tower"
TOKENIZER_FILES = (
    "tokenizer.model",
    "added_tokens.json",
    "special_tokens_map.json",
    "tokenizer_config.json",
)

Tensors = dict[str, torch.Tensor]


def save_lisa(
    model: LisaModel,
    architecture: LisaArchitecture,
    folder: str | Path,
    tokens: SpecialTokens,
    *,
    clip_preprocessing: ClipPreprocessing | None = None,
    tokenizer_folder: str | Path | None = None,
    dtype: torch.dtype | None = None,
    max_shard_bytes: int = 5_000_000_000,
) -> Path:
    """Write a checkpoint folder: language model, projector and SAM under their original names, CLIP in its own folder.

    The folder appears whole or not at all. What is loaded from it equals the model bit for bit, given the same number
    format of SAM's decoder.

    Args:
        model: The weights.
        architecture: Its sizes.
        folder: A new or an empty folder; its parent must exist.
        tokens: Ids of the special tokens, written to `tokens.json`.
        clip_preprocessing: How frames become CLIP's input; None writes the published CLIP's statistics.
        tokenizer_folder: Folder whose tokenizer files are copied.
        dtype: Number format to store; None keeps each weight's own.
        max_shard_bytes: Largest file of weights; a single tensor above it has a file of its own.

    Returns:
        The folder.

    Raises:
        ModelError: The folder isn't empty or can't be written, or `tokenizer_folder` has no tokenizer.model.
    """
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ModelError(f"{target} isn't an empty folder; save into a new one")
    tower, own = split_weights(model, architecture)
    preprocessing = clip_preprocessing or ClipPreprocessing(square_side(architecture.clip.image_size))
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as scratch:
            partial = Path(scratch) / target.name
            (partial / CLIP_FOLDER).mkdir(parents=True)
            write_shards(partial, own, max_shard_bytes, dtype)
            write_json(partial / "config.json", original_config(architecture, tokens, dtype or model.dtype))
            write_json(partial / "sam.json", sam_sidecar(architecture))
            write_json(partial / "tokens.json", tokens.as_json() | {"num_image_tokens": architecture.image_tokens})
            write_shards(partial / CLIP_FOLDER, tower, max_shard_bytes, dtype)
            write_json(partial / CLIP_FOLDER / "config.json", clip_config(architecture))
            write_json(partial / CLIP_FOLDER / "preprocessor_config.json", clip_preprocessor(preprocessing))
            if tokenizer_folder is not None:
                copy_tokenizer(Path(tokenizer_folder), partial)
            partial.replace(target)
    except OSError as error:
        raise ModelError(f"{target} can't be written: {error}") from error
    return target


def split_weights(model: LisaModel, architecture: LisaArchitecture) -> tuple[Tensors, Tensors]:
    """Give the weights of the CLIP tower and those of the rest, each under its original name, once."""
    weights = dict(model.named_parameters(remove_duplicate=False))
    originals = names_by_original(weights, sam_sizes_of(architecture.sam).iou_head_depth)
    named = {original: weights[names[0]].detach() for original, names in originals.items()}
    tower = {name: weight for name, weight in named.items() if name.startswith(CLIP_PREFIX)}
    return tower, {name: weight for name, weight in named.items() if name not in tower}


def write_shards(
    folder: Path, tensors: Mapping[str, torch.Tensor], max_bytes: int, dtype: torch.dtype | None = None
) -> None:
    """Write tensors to `model.safetensors`, or to numbered shards with an index where they exceed `max_bytes`.

    Args:
        folder: Where the files go.
        tensors: By the names they're to have.
        max_bytes: Largest file; a single tensor above it has a file of its own.
        dtype: Number format to convert to; None keeps each tensor's own.
    """
    sizes = {name: tensor.numel() * (dtype or tensor.dtype).itemsize for name, tensor in tensors.items()}
    shards = list(cut_shards(sizes, max_bytes))
    names = [f"model-{number:05}-of-{len(shards):05}.safetensors" for number in range(1, len(shards) + 1)]
    if len(shards) == 1:
        names = ["model.safetensors"]
    for name, shard in zip(names, shards, strict=True):
        # Converted shard by shard: a model that fills a GPU is never held twice.
        content = {key: tensors[key].to(device="cpu", dtype=dtype).contiguous() for key in shard}
        save_file(content, folder / name, metadata={"format": "pt"})
    if len(shards) > 1:
        index = {key: name for name, shard in zip(names, shards, strict=True) for key in shard}
        total = {"total_size": sum(sizes.values())}
        write_json(folder / "model.safetensors.index.json", {"metadata": total, "weight_map": index})


def cut_shards(sizes: Mapping[str, int], max_bytes: int) -> Iterator[list[str]]:
    """Cut names, in their order, into groups whose sizes sum to `max_bytes` at most."""
    shard: list[str] = []
    held = 0
    for name, size in sizes.items():
        if shard and held + size > max_bytes:
            yield shard
            shard, held = [], 0
        shard.append(name)
        held += size
    yield shard


def original_config(architecture: LisaArchitecture, tokens: SpecialTokens, dtype: torch.dtype) -> dict[str, Any]:
    """Give a `config.json` in the original style."""
    llama = architecture.llama
    rope = dict(llama.rope_parameters or {})
    theta = rope.pop("rope_theta", 10000.0)
    return {
        "architectures": ["LISAForCausalLM"],
        "model_type": "llava",
        "attention_bias": llama.attention_bias,
        "bos_token_id": tokens.bos,
        "eos_token_id": tokens.eos,
        "pad_token_id": tokens.pad,
        "hidden_act": llama.hidden_act,
        "hidden_size": llama.hidden_size,
        "image_aspect_ratio": "square",
        "intermediate_size": llama.intermediate_size,
        "max_position_embeddings": llama.max_position_embeddings,
        "mm_hidden_size": architecture.clip.hidden_size,
        "mm_projector_type": architecture.projector,
        "mm_use_im_patch_token": False,
        "mm_use_im_start_end": False,
        "mm_vision_select_feature": architecture.select_feature,
        "mm_vision_select_layer": architecture.select_layer,
        "mm_vision_tower": CLIP_FOLDER,
        "num_attention_heads": llama.num_attention_heads,
        "num_hidden_layers": llama.num_hidden_layers,
        "num_key_value_heads": llama.num_key_value_heads,
        "out_dim": architecture.out_dim,
        "pretraining_tp": 1,
        "rms_norm_eps": llama.rms_norm_eps,
        "rope_scaling": None if rope.get("rope_type", "default") == "default" else rope,
        "rope_theta": theta,
        "tie_word_embeddings": False,
        "torch_dtype": str(dtype).removeprefix("torch."),
        "train_mask_decoder": True,
        "use_cache": False,
        "use_mm_proj": True,
        "vision_tower": CLIP_FOLDER,
        "vocab_size": llama.vocab_size,
    }


def sam_sidecar(architecture: LisaArchitecture) -> dict[str, Any]:
    """Give the content of a `sam.json`."""
    return asdict(sam_sizes_of(architecture.sam)) | {"pixel_mean": list(SAM_MEAN), "pixel_std": list(SAM_STD)}


def clip_config(architecture: LisaArchitecture) -> dict[str, Any]:
    """Give the `config.json` of the CLIP tower's folder."""
    clip = architecture.clip
    return {
        "architectures": ["CLIPVisionModel"],
        "model_type": "clip_vision_model",
        "hidden_act": clip.hidden_act,
        "hidden_size": clip.hidden_size,
        "image_size": square_side(clip.image_size),
        "intermediate_size": clip.intermediate_size,
        "layer_norm_eps": clip.layer_norm_eps,
        "num_attention_heads": clip.num_attention_heads,
        "num_channels": clip.num_channels,
        "num_hidden_layers": clip.num_hidden_layers,
        "patch_size": square_side(clip.patch_size),
    }


def clip_preprocessor(preprocessing: ClipPreprocessing) -> dict[str, Any]:
    """Give the `preprocessor_config.json` of the CLIP tower's folder."""
    size = preprocessing.size
    return {
        "crop_size": {"height": size, "width": size},
        "do_center_crop": True,
        "do_convert_rgb": True,
        "do_normalize": True,
        "do_rescale": True,
        "do_resize": True,
        "image_mean": list(preprocessing.mean),
        "image_processor_type": "CLIPImageProcessor",
        "image_std": list(preprocessing.std),
        "resample": 3,
        "rescale_factor": 1 / 255,
        "size": {"shortest_edge": size},
    }


def copy_tokenizer(source: Path, target: Path) -> None:
    """Copy a tokenizer's files.

    Raises:
        ModelError: There is no tokenizer.model.
    """
    if not (source / TOKENIZER_FILES[0]).is_file():
        raise ModelError(f"{source} has no {TOKENIZER_FILES[0]} to save with the model")
    for name in TOKENIZER_FILES:
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)
