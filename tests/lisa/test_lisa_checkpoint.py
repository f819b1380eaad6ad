"""Loading a LISA++ checkpoint: every tensor in its place, and every fault of a checkpoint named."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa import load_lisa
from cable_models.lisa.architecture import LisaArchitecture
from cable_models.lisa.key_map import names_by_original
from cable_models.lisa.loader import LoadedLisa, build_empty
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_sizes import SamSizes
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lisa_checkpoints import (
    GOLDEN,
    Tensors,
    assert_same_weights,
    edit_json,
    golden_copy,
    golden_tensors,
    needs_golden,
    write_shards,
)
from safetensors.torch import load_file
from transformers import CLIPVisionConfig, CLIPVisionModel, LlamaConfig

pytestmark = needs_golden


@pytest.fixture(scope="module")
def golden() -> LoadedLisa:
    return load_lisa(GOLDEN)


def test_golden_checkpoint_lands_where_the_table_of_keys_says(golden: LoadedLisa) -> None:
    stored = golden_tensors()
    sam = "model.visual_model."
    model = golden.model
    decoder = model.sam.mask_decoder
    prompt = model.sam.prompt_encoder
    places = {
        "lm_head.weight": model.lm_head.weight,
        "model.embed_tokens.weight": model.language_model.embed_tokens.weight,
        "model.layers.1.mlp.down_proj.weight": model.language_model.layers[1].mlp.down_proj.weight,
        "model.norm.weight": model.language_model.norm.weight,
        "model.mm_projector.2.bias": model.mm_projector[2].bias,
        "model.text_hidden_fcs.0.2.weight": model.text_hidden_fcs[2].weight,
        f"{sam}image_encoder.pos_embed": model.sam.vision_encoder.pos_embed,
        f"{sam}image_encoder.blocks.2.norm2.bias": model.sam.vision_encoder.layers[2].layer_norm2.bias,
        f"{sam}image_encoder.blocks.3.attn.rel_pos_w": model.sam.vision_encoder.layers[3].attn.rel_pos_w,
        f"{sam}image_encoder.neck.2.weight": model.sam.vision_encoder.neck.conv2.weight,
        f"{sam}image_encoder.neck.3.weight": model.sam.vision_encoder.neck.layer_norm2.weight,
        f"{sam}prompt_encoder.mask_downscaling.3.weight": prompt.mask_embed.conv2.weight,
        f"{sam}prompt_encoder.mask_downscaling.4.bias": prompt.mask_embed.layer_norm2.bias,
        f"{sam}prompt_encoder.point_embeddings.2.weight": prompt.point_embed[2].weight,
        f"{sam}mask_decoder.transformer.layers.1.norm4.weight": decoder.transformer.layers[1].layer_norm4.weight,
        f"{sam}mask_decoder.output_upscaling.1.weight": decoder.upscale_layer_norm.weight,
        f"{sam}mask_decoder.output_hypernetworks_mlps.3.layers.1.weight": decoder.output_hypernetworks_mlps[3]
        .layers[0]
        .weight,
        f"{sam}mask_decoder.iou_prediction_head.layers.2.bias": decoder.iou_prediction_head.proj_out.bias,
    }
    for name, placed in places.items():
        assert torch.equal(stored[name], placed), name
    matrix = stored[f"{sam}prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"]
    assert torch.equal(matrix, model.sam.shared_image_embedding.positional_embedding)
    assert prompt.shared_embedding.positional_embedding is model.sam.shared_image_embedding.positional_embedding


def test_every_stored_number_is_loaded(golden: LoadedLisa) -> None:
    stored = [tensor for name, tensor in golden_tensors().items() if "inv_freq" not in name]
    stored += load_file(GOLDEN / "clip_vision_tower" / "model.safetensors").values()
    loaded = [tensor for _, tensor in golden.model.named_parameters()]
    assert len(loaded) == len(stored)
    assert sorted(float(tensor.double().sum()) for tensor in loaded) == sorted(float(t.double().sum()) for t in stored)
    assert not any(tensor.requires_grad or tensor.is_meta for tensor in loaded)
    assert not golden.model.training


def test_golden_facts(golden: LoadedLisa) -> None:
    assert (golden.tokens.seg, golden.tokens.im_start, golden.tokens.im_end) == (97, 98, 99)
    assert (golden.tokens.bos, golden.tokens.eos, golden.tokens.pad, golden.tokens.image_placeholder) == (1, 2, 0, -200)
    assert golden.tokenizer is None
    assert golden.architecture.image_tokens == 16
    assert golden.clip_preprocessing.size == 56
    assert golden.architecture.llama.rms_norm_eps == 1e-5


def test_loading_equals_building_the_usual_way(golden: LoadedLisa) -> None:
    built = LisaModel(golden.architecture).eval()
    built.load_state_dict(golden.model.state_dict())
    assert_same_weights(golden.model, built)
    ids = torch.arange(2, 40)[None]
    states = [model.language_model(ids).last_hidden_state for model in (golden.model, built)]
    assert torch.equal(*states)


def test_rotary_frequencies_stay_float32_and_the_decoder_may_too() -> None:
    whole = load_lisa(GOLDEN)
    half = load_lisa(GOLDEN, dtype=torch.bfloat16, decoder_dtype=torch.float32)
    rotary = half.model.language_model.rotary_emb.inv_freq
    assert rotary.dtype == torch.float32
    assert torch.equal(rotary, whole.model.language_model.rotary_emb.inv_freq)
    # The exponents of theta are exact in float32 at these sizes, so the powers may differ by one rounding only.
    assert torch.allclose(rotary, 10000.0 ** (-torch.arange(0, 16, 2) / 16), rtol=1e-6)
    for name, parameter in half.model.named_parameters(remove_duplicate=False):
        decoder = name.startswith(("sam.prompt_encoder", "sam.mask_decoder", "sam.shared_image_embedding"))
        source = whole.model.get_parameter(name)
        assert torch.equal(parameter, source if decoder else source.to(torch.bfloat16)), name


def test_format_of_config_is_the_default(tmp_path: Path) -> None:
    edit_json(golden_copy(tmp_path) / "config.json", torch_dtype="bfloat16")
    assert load_lisa(tmp_path).model.dtype == torch.bfloat16
    edit_json(tmp_path / "config.json", torch_dtype=None)
    assert load_lisa(tmp_path).model.dtype == torch.float32
    edit_json(tmp_path / "config.json", torch_dtype="int4")
    with pytest.raises(ModelError, match="'int4' is none of float32, bfloat16, float16"):
        load_lisa(tmp_path)


@pytest.mark.parametrize("kind", ["safetensors", "bin", "one bin"])
def test_other_files_of_the_same_tensors(kind: str, tmp_path: Path, golden: LoadedLisa) -> None:
    golden_copy(tmp_path)
    if kind == "one bin":
        (tmp_path / "model.safetensors").unlink()
        torch.save(golden_tensors(), tmp_path / "pytorch_model.bin")
    else:
        write_shards(tmp_path, golden_tensors(), kind)
    assert_same_weights(load_lisa(tmp_path).model, golden.model)


@pytest.mark.parametrize(
    ("vocabulary", "keys", "numbers"),
    [(32001, 925, 7_418_326_576), (32003, 925, 7_418_326_576 + 4 * 4096)],
    ids=["seg", "seg and image marks"],
)
def test_published_size_has_the_tensors_of_the_original(vocabulary: int, keys: int, numbers: int) -> None:
    """925 tensors and 7.418e9 numbers with the rotary tables, counted on the original code at this size."""
    sam = SamSizes(
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
    clip = CLIPVisionConfig(
        hidden_size=1024, intermediate_size=4096, num_hidden_layers=24, num_attention_heads=16, patch_size=14
    )
    llama = LlamaConfig(vocab_size=vocabulary)
    model = build_empty(LisaArchitecture(llama, clip, sam.config(), "mlp2x_gelu", -2, "patch", 256))
    originals = names_by_original([name for name, _ in model.named_parameters(remove_duplicate=False)], 3)
    own = {original: names for original, names in originals.items() if not original.startswith("vision_model.")}
    sizes = {original: model.get_parameter(names[0]).numel() for original, names in own.items()}
    assert len(sizes) + 32 == keys
    assert sum(sizes.values()) + 32 * 64 == numbers
    parts = {"image_encoder": 637_026_048, "prompt_encoder": 6_476, "mask_decoder": 4_058_340}
    for part, count in parts.items():
        assert sum(n for name, n in sizes.items() if name.startswith(f"model.visual_model.{part}.")) == count


FREE_NAMES = sorted(golden_tensors()) if GOLDEN.is_dir() else []
FREE_NAMES = [name for name in FREE_NAMES if "inv_freq" not in name]


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(FREE_NAMES or [""]), fault=st.sampled_from(["remove", "rename", "reshape"]))
def test_any_faulty_tensor_is_named(name: str, fault: str, tmp_path: Path) -> None:
    def change(tensors: Tensors) -> None:
        tensor = tensors.pop(name)
        if fault == "rename":
            tensors[f"{name}_old"] = tensor
        elif fault == "reshape":
            tensors[name] = torch.cat([tensor, tensor[:1]])

    with pytest.raises(ModelError, match=re.escape(name.split(".")[-2])):
        load_lisa(golden_copy(tmp_path, change))


@pytest.mark.parametrize("changes", [{"num_attention_heads": 7}, {"rms_norm_eps": "small"}, {"hidden_act": "none"}])
def test_sizes_nothing_can_be_built_of(changes: dict[str, object], tmp_path: Path) -> None:
    edit_json(golden_copy(tmp_path) / "config.json", **changes)
    with pytest.raises(ModelError, match=r"no model can be built of these sizes"):
        load_lisa(tmp_path)


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    def change(tensors: Tensors) -> None:
        for name in [name for name in tensors if name.startswith("model.layers.1.") and "inv_freq" not in name]:
            tensors[f"lora.{name}"] = tensors.pop(name)
        for name in [name for name in tensors if name.startswith("model.layers.0.mlp")]:
            tensors[name] = tensors[name].T.contiguous()

    with pytest.raises(ModelError) as told:
        load_lisa(golden_copy(tmp_path, change))
    text = str(told.value)
    assert "21 faults" in text
    assert "missing model.layers.1.input_layernorm.weight" in text
    assert "unexpected lora.model.layers.1.input_layernorm.weight" in text
    assert "model.layers.0.mlp.down_proj.weight is [160, 64], not [64, 160]" in text
    assert text.count(";") == 20


# ------------------------------------------------------------------------------------------------- the CLIP tower


def test_tower_from_a_whole_clip(tmp_path: Path, golden: LoadedLisa) -> None:
    """The published CLIP repositories hold both halves, an old table of indexes, and the sizes under vision_config."""
    folder = golden_copy(tmp_path / "lisa")
    clip = tmp_path / "clip"
    (folder / "clip_vision_tower").rename(clip)
    vision = {"hidden_size": 48, "intermediate_size": 96, "num_hidden_layers": 3, "num_attention_heads": 4}
    vision |= {"image_size": 56, "patch_size": 14, "model_type": "clip_vision_model", "num_beams": 1}
    (clip / "config.json").unlink()
    (clip / "config.json").write_text("{}")
    edit_json(clip / "config.json", model_type="clip", vision_config=vision, text_config={"hidden_size": 512})
    tensors = load_file(clip / "model.safetensors") | {
        "logit_scale": torch.ones(()),
        "text_model.final_layer_norm.weight": torch.ones(8),
        "visual_projection.weight": torch.ones(8, 48),
        "vision_model.embeddings.position_ids": torch.arange(17)[None],
    }
    (clip / "model.safetensors").unlink()
    torch.save(tensors, clip / "pytorch_model.bin")
    (clip / "preprocessor_config.json").unlink()
    loaded = load_lisa(folder, clip=clip)
    assert_same_weights(loaded.model, golden.model)
    assert loaded.clip_preprocessing == golden.clip_preprocessing


def test_tower_as_transformers_saves_it(tmp_path: Path, golden: LoadedLisa) -> None:
    folder = golden_copy(tmp_path / "lisa")
    CLIPVisionModel.from_pretrained(GOLDEN / "clip_vision_tower").save_pretrained(tmp_path / "clip")
    edit_json(folder / "config.json", vision_tower=str(tmp_path / "clip"))
    assert_same_weights(load_lisa(folder).model, golden.model)


def test_tower_inside_the_checkpoint(tmp_path: Path, golden: LoadedLisa) -> None:
    tower = load_file(GOLDEN / "clip_vision_tower" / "model.safetensors")
    # Heads leave no trace in the shapes: without a configuration they have CLIP's 64 channels.
    wide = {name: torch.cat([tensor, tensor[:16]]) for name, tensor in tower.items() if tensor.shape == (48,)}
    assert wide

    def inside(tensors: Tensors) -> None:
        for name, tensor in tower.items():
            for axis in range(tensor.ndim):
                if tensor.shape[axis] == 48:
                    tensor = torch.cat([tensor, tensor.narrow(axis, 0, 16)], axis)
            tensors[f"model.vision_tower.vision_tower.{name}"] = tensor.contiguous()
        projector = tensors["model.mm_projector.0.weight"]
        tensors["model.mm_projector.0.weight"] = torch.cat([projector, projector[:, :16]], 1)

    folder = golden_copy(tmp_path, inside)
    (folder / "clip_vision_tower").rename(tmp_path / "elsewhere")
    edit_json(folder / "config.json", vision_tower="openai/clip-vit-large-patch14")
    loaded = load_lisa(folder)
    assert loaded.architecture.image_tokens == 16
    assert loaded.architecture.clip.num_attention_heads == 1
    bias = loaded.model.vision_tower.state_dict()
    name = next(name for name in bias if name.endswith("pre_layrnorm.bias"))
    assert torch.equal(bias[name], wide["vision_model.pre_layrnorm.bias"])


def test_wrong_towers(tmp_path: Path) -> None:
    folder = golden_copy(tmp_path / "lisa")
    with pytest.raises(ModelError, match="holds no CLIP image tower"):
        load_lisa(folder, clip=folder)
    edit_json(folder / "clip_vision_tower" / "config.json", model_type="siglip_vision_model")
    with pytest.raises(ModelError, match="siglip"):
        load_lisa(folder)
    edit_json(folder / "clip_vision_tower" / "config.json", model_type="clip_vision_model", hidden_size=64)
    with pytest.raises(ModelError, match="features of 48 numbers, this CLIP tower gives 64"):
        load_lisa(folder)
    edit_json(folder / "clip_vision_tower" / "config.json", hidden_size=48, image_size=84)
    with pytest.raises(ModelError, match=r"crops to \[56\] pixels, its config.json says 84"):
        load_lisa(folder)
    edit_json(folder / "config.json", vision_tower=None, mm_vision_tower=None)
    with pytest.raises(ModelError, match="give its folder or hub id as `clip`"):
        load_lisa(folder)
