"""Random models of stated sizes, and the published inference on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa import FrameRequest, LisaPipeline, load_lisa
from cable_models.lisa.flops import blank_frame, meta_lisa
from cable_models.lisa.mask_decoder import upsample_logits
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.original import Question, original_frame, typical_question
from cable_models.lisa.random_weights import lisa_7b, lisa_small, lisa_tiny, random_lisa, random_loaded
from cable_models.lisa.stage_timer import StageTimer

GOLDENS = Path(__file__).resolve().parents[3] / "shared" / "golden"
FOLDERS = sorted(path for path in GOLDENS.glob("lisa_*") if (path / "outputs_generate.npz").is_file())


def test_published_sizes_have_the_published_number_of_weights() -> None:
    """Numbers of the checkpoint's tensors, CLIP ViT-L/14 apart, which lies outside it."""
    shapes = meta_lisa(lisa_7b())
    parts = {
        "language_model.layers": 6_476_267_520,
        "language_model.embed_tokens": 131_076_096,
        "lm_head": 131_076_096,
        "mm_projector": 20_979_712,
        "text_hidden_fcs": 17_830_144,
        "sam.vision_encoder": 637_026_048,
        "sam.mask_decoder": 4_058_340,
    }
    for part, expected in parts.items():
        assert sum(weight.numel() for weight in shapes.get_submodule(part).parameters()) == expected, part
    assert lisa_7b(224).image_tokens == 256
    assert lisa_7b(336).image_tokens == 576
    assert lisa_small().image_tokens == 256


def test_weights_are_drawn_in_place_and_repeatably() -> None:
    model = random_lisa(lisa_tiny(), dtype=torch.bfloat16, seed=3)
    assert {weight.dtype for weight in model.parameters()} == {torch.bfloat16}
    assert not any(tensor.is_meta for tensor in (*model.parameters(), *model.buffers()))
    again = random_lisa(lisa_tiny(), dtype=torch.bfloat16, seed=3)
    other = random_lisa(lisa_tiny(), dtype=torch.bfloat16, seed=4)
    for name, weight in model.named_parameters():
        assert torch.equal(weight, again.get_parameter(name)), name
        assert not torch.equal(weight, other.get_parameter(name)), name
        assert weight.float().std() > 0, name
    sam = model.sam
    assert sam.prompt_encoder.shared_embedding.positional_embedding is sam.shared_image_embedding.positional_embedding


def test_activations_keep_the_size_of_a_trained_model() -> None:
    torch.set_num_threads(1)
    model = random_lisa(lisa_tiny())
    question = typical_question(101, 30)
    loaded = random_loaded(model)
    pipeline = LisaPipeline(loaded, LisaOptions(forced_ids=question.answer, verify_frames=0))
    frame = np.random.default_rng(0).integers(0, 256, (180, 320, 3), np.uint8)
    (answer,) = pipeline.segment([FrameRequest(frame, None, question.ids)])
    assert np.isfinite(answer.mask_logits).all()
    assert 1e-3 < np.abs(answer.mask_logits).mean() < 1e2


@pytest.mark.skipif(not FOLDERS, reason=f"no reference tensors of the original code in {GOLDENS}")
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
def test_cacheless_inference_gives_the_masks_of_the_original(folder: Path) -> None:
    torch.set_num_threads(1)
    loaded = load_lisa(str(folder), dtype=torch.float32)
    inputs, outputs = np.load(folder / "inputs.npz"), np.load(folder / "outputs_generate.npz")
    prompt = inputs["input_ids_prompt"][0].tolist()
    answer = outputs["token_ids"][0].tolist()[len(prompt) :]
    question = Question(tuple(prompt), tuple(answer), loaded.tokens)
    timer = StageTimer(torch.device("cpu"))
    pixels = [torch.from_numpy(inputs[name]) for name in ("images_clip", "images_sam")]
    low_resolution = original_frame(loaded.model, *pixels, question, timer)
    resized, frame_hw = (tuple(inputs[name].tolist()) for name in ("resize_size", "original_size"))
    logits = upsample_logits(low_resolution, resized, frame_hw, pixels[1].shape[-1]).numpy()
    np.testing.assert_allclose(logits, outputs["mask_logits"], atol=1e-4 * np.abs(outputs["mask_logits"]).max(), rtol=0)
    stages = {"clip", "projector", "prefill", "lm_head", "sam_encoder", "mask_decoder"}
    assert set(timer.durations_ns()) == stages | ({"decode"} if len(answer) > 1 else set())


def test_typical_question_is_as_long_as_asked() -> None:
    question = typical_question(32001)
    assert len(question.ids) == 94 + 1
    assert question.ids.count(question.tokens.image_placeholder) == 1
    assert len(question.answer) == 5
    assert question.masks == 1
    assert max(question.ids) < question.tokens.seg == 32000
    with pytest.raises(ModelError, match="2 tokens"):
        typical_question(32001, 1)


def test_blank_frame_follows_the_switches() -> None:
    shapes = meta_lisa(lisa_tiny())
    roi = np.zeros((180, 320), np.bool_)
    roi[:90] = True
    assert blank_frame(shapes, (180, 320)).kept_patches is None
    kept = blank_frame(shapes, (180, 320), roi).kept_patches
    assert kept is not None
    assert len(kept) == 8
