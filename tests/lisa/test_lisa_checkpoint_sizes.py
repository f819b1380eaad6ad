"""Sizes read off the tensors, the sidecar file's word on them, and a model saved and loaded again."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa import load_lisa
from cable_models.lisa.architecture import ClipPreprocessing, projector_depth, read_architecture, read_clip_config
from cable_models.lisa.sam_sizes import SAM_PREFIX, read_sam_sizes, sam_sizes_of
from cable_models.lisa.saver import save_lisa
from cable_models.lisa.special_tokens import SpecialTokens, read_special_tokens
from lisa_checkpoints import (
    GOLDEN,
    UNLIKE_SAM,
    assert_same_weights,
    edit_json,
    golden_tensors,
    needs_golden,
    unlike_architecture,
    unlike_model,
)
from safetensors import safe_open

TOKENS = SpecialTokens(seg=50, im_start=51, im_end=52)
Shapes = dict[str, tuple[int, ...]]


def stored_shapes(folder: Path) -> Shapes:
    shapes: Shapes = {}
    for path in folder.glob("*.safetensors"):
        with safe_open(path, "pt") as file:
            shapes |= {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    return shapes


@pytest.fixture(scope="module")
def unlike(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "unlike"
    preprocessing = ClipPreprocessing(84, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    return save_lisa(unlike_model(), unlike_architecture(), folder, TOKENS, clip_preprocessing=preprocessing)


@needs_golden
def test_golden_sizes_follow_from_its_tensors() -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in golden_tensors().items()}
    inferred = asdict(read_sam_sizes(shapes))
    said = json.loads((GOLDEN / "sam_tiny.json").read_text())
    shared = inferred.keys() & said.keys()
    assert len(shared) == len(inferred) - 1  # num_pos_feats has no name there
    assert {name: inferred[name] for name in shared} == {
        name: tuple(said[name]) if isinstance(said[name], list) else said[name] for name in shared
    }
    assert inferred["num_pos_feats"] == said["output_channels"] / 2


def test_unlike_sizes_follow_from_the_tensors(unlike: Path) -> None:
    assert read_sam_sizes(stored_shapes(unlike)) == UNLIKE_SAM
    assert sam_sizes_of(UNLIKE_SAM.config()) == UNLIKE_SAM


def test_sidecar_gives_what_shapes_cannot(unlike: Path) -> None:
    shapes = stored_shapes(unlike)
    assert read_sam_sizes(shapes, {"decoder_num_heads": 4}).decoder_num_heads == 4
    with pytest.raises(ModelError, match="5 heads don't divide the mask decoder's 24 attention channels"):
        read_sam_sizes(shapes, {"decoder_num_heads": 5})


@pytest.mark.parametrize(
    "said",
    [
        {"image_size": 128},
        {"patch_size": 16},
        {"vision_num_heads": 4},
        {"window_size": 14},
        {"global_attn_indexes": [1]},
        {"qkv_bias": True},
        {"mask_input_channels": 16},
        {"num_multimask_outputs": 3},
        {"iou_head_depth": 3},
        {"pixel_mean": [0.0, 0.0, 0.0]},
        {"use_rel_pos": False},
    ],
    ids=lambda said: next(iter(said)),
)
def test_contradicting_sidecar(said: dict[str, Any], unlike: Path) -> None:
    name, value = next(iter(said.items()))
    if isinstance(value, list) and name.startswith("global"):
        value = tuple(value)
    with pytest.raises(ModelError) as told:
        read_sam_sizes(stored_shapes(unlike), said)
    assert f"{name}: {value!r} in the sidecar" in str(told.value)


def test_window_as_wide_as_the_grid_is_global_attention(unlike: Path) -> None:
    """Either layout gives the same tables and the same numbers, so the sidecar's word is taken."""
    shapes = stored_shapes(unlike)
    block = f"{SAM_PREFIX}image_encoder.blocks.1.attn.rel_pos_"
    shapes |= {f"{block}h": (23, 20), f"{block}w": (23, 20)}
    assert read_sam_sizes(shapes).global_attn_indexes == (0, 1, 2)
    said = {"window_size": 12, "global_attn_indexes": [2]}
    assert read_sam_sizes(shapes, said).global_attn_indexes == (2,)


@pytest.mark.parametrize(
    ("name", "shape", "told"),
    [
        ("image_encoder.pos_embed", (1, 12, 14, 60), "12x14"),
        ("image_encoder.pos_embed", (12, 12), "4 dimensions were expected"),
        ("image_encoder.pos_embed", None, "which gives SAM's sizes"),
        ("image_encoder.blocks.1.attn.rel_pos_h", None, "blocks.1.attn.rel_pos_h"),
        ("image_encoder.blocks.0.attn.rel_pos_h", (7, 20), r"\[7, 9\] rows"),
        ("image_encoder.blocks.0.attn.rel_pos_h", (23, 7), "7 channels"),
        ("mask_decoder.transformer.final_attn_token_to_image.q_proj.weight", (7, 48), "7 channels isn't half"),
    ],
)
def test_impossible_shapes(name: str, shape: tuple[int, ...] | None, told: str, unlike: Path) -> None:
    shapes = stored_shapes(unlike)
    del shapes[SAM_PREFIX + name]
    if shape is not None:
        shapes[SAM_PREFIX + name] = shape
    with pytest.raises(ModelError, match=told):
        read_sam_sizes(shapes)


def test_checkpoint_without_sam() -> None:
    with pytest.raises(ModelError, match="holds no SAM"):
        read_sam_sizes({"model.norm.weight": (4,)})


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"hidden_size": 48}, "hidden_size 48"),
        ({"out_dim": 256}, "out_dim 256, but model.text_hidden_fcs.0.2.weight has 48 rows"),
        ({"mm_projector_type": "mlp2x_gelu"}, "'mlp2x_gelu', but the tensors are those of 'linear'"),
        ({"mm_vision_select_feature": "cls"}, "neither 'patch' nor 'cls_patch'"),
        ({"mm_vision_select_layer": 7}, "5 hidden states"),
        ({"num_attention_heads": None}, "num_attention_heads"),
        ({"mm_projector_type": "identity"}, "'identity'"),
    ],
)
def test_contradicting_configuration(changes: dict[str, Any], told: str, unlike: Path) -> None:
    config = json.loads((unlike / "config.json").read_text()) | changes
    clip = json.loads((unlike / "clip_vision_tower" / "config.json").read_text())
    with pytest.raises(ModelError, match=told):
        read_architecture(config, stored_shapes(unlike), clip)


def test_vocabulary_is_that_of_the_embeddings(unlike: Path) -> None:
    config = json.loads((unlike / "config.json").read_text()) | {"vocab_size": 32000, "mm_projector_type": None}
    clip = json.loads((unlike / "clip_vision_tower" / "config.json").read_text())
    architecture = read_architecture(config, stored_shapes(unlike), clip)
    assert architecture.llama.vocab_size == 53
    assert architecture.projector == "linear"
    with_class = read_architecture(config | {"mm_vision_select_feature": "cls_patch"}, stored_shapes(unlike), clip)
    assert (architecture.image_tokens, with_class.image_tokens) == (36, 37)


def test_scaled_positions_in_the_original_style(unlike: Path) -> None:
    config = json.loads((unlike / "config.json").read_text())
    clip = json.loads((unlike / "clip_vision_tower" / "config.json").read_text())
    del config["rope_theta"]
    config["rope_scaling"] = {"type": "linear", "factor": 4.0}
    rope = read_architecture(config, stored_shapes(unlike), clip).llama.rope_parameters
    assert dict(rope) == {"rope_type": "linear", "factor": 4.0, "rope_theta": 10000.0}


def test_sizes_left_out_of_a_clip_are_the_formats_own() -> None:
    assert read_clip_config({"vision_config": {"patch_size": 16}}).hidden_size == 768


def test_unknown_projectors() -> None:
    assert [projector_depth(kind) for kind in ("linear", "mlp2x_gelu", "mlp3x_gelu")] == [1, 2, 3]
    with pytest.raises(ModelError, match="'identity'"):
        projector_depth("identity")


# --------------------------------------------------------------------------------------------- saved and loaded


def test_saved_model_loads_bit_for_bit(unlike: Path) -> None:
    loaded = load_lisa(unlike)
    assert_same_weights(loaded.model, unlike_model())
    assert loaded.tokens == TOKENS
    assert loaded.clip_preprocessing == ClipPreprocessing(84, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    one, other = loaded.architecture, unlike_architecture()
    assert (one.llama.to_dict(), one.clip.to_dict()) == (other.llama.to_dict(), other.clip.to_dict())
    assert sam_sizes_of(one.sam) == sam_sizes_of(other.sam)
    assert one.projector, one.select_layer == (other.projector, other.select_layer)


def test_saved_model_loads_without_its_sidecar_and_from_shards(tmp_path: Path) -> None:
    model = unlike_model().bfloat16()
    folder = save_lisa(model, model.architecture, tmp_path / "cut", TOKENS, max_shard_bytes=40_000)
    assert len(list(folder.glob("model-0*-of-0*.safetensors"))) > 3
    assert all(path.stat().st_size < 50_000 for path in folder.glob("*.safetensors"))
    (folder / "sam.json").unlink()
    loaded = load_lisa(folder).model
    assert loaded.dtype == torch.bfloat16
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter, loaded.get_parameter(name)), name
    again = save_lisa(loaded, loaded.architecture, tmp_path / "whole", TOKENS)
    assert_same_weights(load_lisa(again).model, loaded)


@needs_golden
def test_saving_the_golden_keeps_its_tensors(tmp_path: Path) -> None:
    loaded = load_lisa(GOLDEN)
    folder = save_lisa(loaded.model, loaded.architecture, tmp_path / "golden", loaded.tokens)
    with safe_open(folder / "model.safetensors", "pt") as file:
        saved = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    stored = {name: tensor for name, tensor in golden_tensors().items() if "inv_freq" not in name}
    assert saved.keys() == stored.keys()
    assert all(torch.equal(saved[name], tensor) for name, tensor in stored.items())
    config, original = (json.loads((place / "config.json").read_text()) for place in (folder, GOLDEN))
    assert {name: config[name] for name in config.keys() & original.keys()} == {
        name: original[name] for name in config.keys() & original.keys()
    }


def test_half_precision_on_request(tmp_path: Path) -> None:
    model = unlike_model()
    folder = save_lisa(model, model.architecture, tmp_path / "half", TOKENS, dtype=torch.float16)
    loaded = load_lisa(folder).model
    assert torch.equal(loaded.lm_head.weight, model.lm_head.weight.half())


def test_tokenizer_files_are_copied(tmp_path: Path) -> None:
    source = tmp_path / "tokenizer"
    source.mkdir()
    for name in ("tokenizer.model", "added_tokens.json", "notes.txt"):
        (source / name).write_text(name)
    model = unlike_model()
    folder = save_lisa(model, model.architecture, tmp_path / "new", TOKENS, tokenizer_folder=source)
    assert (folder / "tokenizer.model").read_text() == "tokenizer.model"
    assert (folder / "added_tokens.json").exists()
    assert not (folder / "notes.txt").exists()


def test_saving_leaves_nothing_half_done(tmp_path: Path) -> None:
    model = unlike_model()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").write_text("mine")
    with pytest.raises(ModelError, match="isn't an empty folder"):
        save_lisa(model, model.architecture, tmp_path / "taken", TOKENS)
    with pytest.raises(ModelError, match=r"no tokenizer\.model to save"):
        save_lisa(model, model.architecture, tmp_path / "new", TOKENS, tokenizer_folder=tmp_path)
    with pytest.raises(ModelError, match="can't be written"):
        save_lisa(model, model.architecture, tmp_path / "absent" / "new", TOKENS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["taken"]


# ------------------------------------------------------------------------------------------------ special tokens


def test_tokens_by_name(unlike: Path, tmp_path: Path) -> None:
    (tmp_path / "tokenizer_config.json").write_text(
        json.dumps({"added_tokens_decoder": {"0": {"content": "<unk>"}, "40": {"content": "[SEG]"}}})
    )
    assert read_special_tokens(tmp_path, {"pad_token_id": 3}) == SpecialTokens(seg=40, pad=3)
    (tmp_path / "added_tokens.json").write_text(json.dumps({"[SEG]": 41, "<im_start>": 42}))
    assert read_special_tokens(tmp_path, {}) == SpecialTokens(seg=41)
    edit_json(tmp_path / "added_tokens.json", **{"<im_end>": 43})
    assert read_special_tokens(tmp_path, {}) == SpecialTokens(seg=41, im_start=42, im_end=43)
    (tmp_path / "tokens.json").write_text(json.dumps({"seg_token_idx": 7, "im_start_id": None}))
    assert read_special_tokens(tmp_path, {}) == SpecialTokens(seg=7)
    (tmp_path / "tokens.json").write_text(json.dumps({"seg_token_idx": "7"}))
    with pytest.raises(ModelError, match="no token ids"):
        read_special_tokens(tmp_path, {})
    with pytest.raises(ModelError, match=r"no \[SEG\] among the added tokens"):
        read_special_tokens(unlike / "clip_vision_tower", {})
    with pytest.raises(ModelError, match=r"\{'\[SEG\]': 41\} have no row in an embedding table of 41 rows"):
        SpecialTokens(seg=41).within(41)
