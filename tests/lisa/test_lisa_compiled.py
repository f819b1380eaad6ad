"""The deep stacks against the unmodified modules of transformers, plain and compiled."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
from cable_models.errors import ModelError
from cable_models.lisa.compiled import CompileMode, Stacks, compiled_stacks
from cable_models.lisa.model import LisaModel
from cable_models.lisa.random_weights import lisa_tiny, random_lisa
from transformers import DynamicCache


@pytest.fixture(scope="module")
def model() -> LisaModel:
    torch.set_num_threads(1)
    return random_lisa(lisa_tiny())


def agree(stacks: Stacks, model: LisaModel, tolerance: float) -> None:
    """Every stack gives what the module gives by itself."""
    random = torch.Generator().manual_seed(5)
    for batch, length in ((1, 24), (1, 40), (2, 32)):
        embeddings = torch.randn(batch, length, 64, generator=random)
        gaps = torch.arange(length).mul(3).expand(batch, -1)
        everything = torch.ones(batch, length, dtype=torch.bool)
        expected = model.language_model(inputs_embeds=embeddings, position_ids=gaps, attention_mask=everything)
        found = stacks.language(model.language_model, embeddings, gaps)
        torch.testing.assert_close(found, expected.last_hidden_state, atol=tolerance, rtol=0)
        clip_pixels = torch.randn(batch, 3, 56, 56, generator=random)
        states = model.vision_tower(clip_pixels, output_hidden_states=True).hidden_states
        blocks = getattr(model.vision_tower, "vision_model", model.vision_tower).encoder.layers
        torch.testing.assert_close(stacks.clip(list(blocks)[:2], states[0], None), states[2], atol=tolerance, rtol=0)
        sam_pixels = torch.randn(batch, 3, 256, 256, generator=random)
        encoder = model.sam.vision_encoder
        torch.testing.assert_close(stacks.sam(encoder, sam_pixels), encoder(sam_pixels)[0], atol=tolerance, rtol=0)


def test_plain_stacks_are_the_modules_of_transformers_bit_for_bit(model: LisaModel) -> None:
    with torch.inference_mode():
        agree(Stacks(), model, tolerance=0.0)


def test_a_cache_takes_one_token_after_another(model: LisaModel) -> None:
    from cable_models.lisa.compiled import decoder_stack

    embeddings = torch.randn(1, 9, 64, generator=torch.Generator().manual_seed(1))
    positions = torch.tensor([[0, 1, 5, 6, 9, 12, 13, 14, 15]])
    cache = DynamicCache(config=model.language_model.config)
    with torch.inference_mode():
        whole = decoder_stack(model.language_model, embeddings, positions)
        steps = [decoder_stack(model.language_model, embeddings[:, :6], positions[:, :6], cache)]
        steps += [
            decoder_stack(model.language_model, embeddings[:, i : i + 1], positions[:, i : i + 1], cache)
            for i in range(6, 9)
        ]
    torch.testing.assert_close(torch.cat(steps, 1), whole, atol=2e-6, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [mode for mode in get_args(CompileMode) if mode != "none"])
def test_compiled_stacks_agree_with_the_modules(model: LisaModel, mode: CompileMode) -> None:
    with torch.inference_mode():
        agree(compiled_stacks(mode), model, tolerance=1e-5)


def test_an_unknown_mode_is_refused() -> None:
    assert compiled_stacks("none") == Stacks()
    with pytest.raises(ModelError, match="unknown compile mode 'fast'"):
        compiled_stacks("fast")  # type: ignore[arg-type]
