"""Operations of one frame at the published sizes, against the reference table of the original and closed formulas."""

from __future__ import annotations

import numpy as np
import pytest
from cable_models.lisa.flops import blank_frame, count_forced, count_generated, count_original, meta_lisa
from cable_models.lisa.model import LisaModel
from cable_models.lisa.options import PLAIN, LisaOptions
from cable_models.lisa.original import Question, typical_question
from cable_models.lisa.prefill_cost import prefill_flops
from cable_models.lisa.random_weights import lisa_7b, lisa_tiny

TERA = 10**12
FRAME = (900, 1600)
CLIP_BLOCK = 0.162 / 24
"""TFLOP of one of CLIP's blocks at 224 pixels; the table has 24 of them, of which 23 are needed."""


@pytest.fixture(scope="module")
def shapes() -> LisaModel:
    return meta_lisa(lisa_7b(224))


@pytest.fixture(scope="module")
def question() -> Question:
    return typical_question(32001)


def tera(operations: int) -> float:
    return operations / TERA


def test_forced_pass_matches_the_reference_table(shapes: LisaModel, question: Question) -> None:
    counted = count_forced(shapes, blank_frame(shapes, FRAME, None, PLAIN), question)
    assert tera(counted.total) == pytest.approx(10.76 - CLIP_BLOCK, rel=0.002)
    assert tera(counted.prefill) == pytest.approx(4.624, rel=1e-3)
    assert tera(counted.clip) == pytest.approx(0.162 - CLIP_BLOCK, rel=0.01)
    assert tera(counted.projector) == pytest.approx(0.011, rel=0.05)
    assert tera(counted.sam_encoder) == pytest.approx(5.961, rel=1e-3)
    assert tera(counted.mask_decoder) == pytest.approx(0.0036 + 0.00004, rel=0.01)
    assert counted.decode == counted.lm_head == 0


@pytest.mark.slow
def test_original_and_cached_decoding_match_the_reference_table(shapes: LisaModel, question: Question) -> None:
    frame = blank_frame(shapes, FRAME, None, PLAIN)
    original = count_original(shapes, frame, question)
    assert tera(original.total) == pytest.approx(30.4, rel=0.002)
    assert tera(original.total - original.sam_encoder - original.mask_decoder) == pytest.approx(24.45, rel=0.002)
    assert tera(original.clip) == pytest.approx(5 * 0.162, rel=0.005)
    assert tera(original.prefill) == pytest.approx(4.597, rel=1e-3)
    assert tera(original.lm_head / 5) == pytest.approx(0.092, rel=0.01)
    cached = count_generated(shapes, frame, question)
    assert tera(cached.total) == pytest.approx(10.79 - CLIP_BLOCK, rel=0.002)
    assert tera((cached.decode + cached.lm_head) / 4) == pytest.approx(0.0134, rel=0.02)


@pytest.mark.slow
def test_larger_clip_matches_the_reference_table(question: Question) -> None:
    shapes = meta_lisa(lisa_7b(336))
    frame = blank_frame(shapes, FRAME, None, PLAIN)
    assert tera(count_original(shapes, frame, question).total) == pytest.approx(53.6, rel=0.002)
    assert tera(count_forced(shapes, frame, question).total) == pytest.approx(15.31 - 0.382 / 24, rel=0.002)


def test_a_quarter_of_the_frame_takes_an_eighth_of_the_original(shapes: LisaModel, question: Question) -> None:
    """A road corridor of full width: rows 428..652 of 900 meet rows 7..11 of CLIP's 16 rows of patches."""
    roi = np.zeros(FRAME, np.bool_)
    roi[428:653] = True
    options = LisaOptions(image_tokens="drop", clip_patches="drop", sam_windows="tokens")
    frame = blank_frame(shapes, FRAME, roi, options)
    assert frame.kept_patches is not None
    assert len(frame.kept_patches) == 5 * 16
    counted = count_forced(shapes, frame, question, clip_patches=True)
    text_and_image = 94 + 80 + 2
    assert tera(counted.prefill) == pytest.approx(
        12.952e-3 * text_and_image * (1 + 4.05e-5 * text_and_image), rel=0.002
    )
    assert counted.prefill == pytest.approx(prefill_flops(shapes.architecture.llama, text_and_image), rel=1e-6)
    # A global block's linear layers take 161 GFLOP for 4096 tokens; attention comes on top.
    linear = 32 * 0.161 * frame.sam_plan.token_count / 4096
    assert linear < tera(counted.sam_encoder) < linear + 0.35
    assert tera(counted.total) < 4.0
    assert 30.4 / tera(counted.total) > 7.5


@pytest.mark.parametrize("switch", ["image_tokens", "clip_patches", "sam_windows"])
def test_every_switch_lowers_its_own_stage_only(switch: str) -> None:
    shapes, question = meta_lisa(lisa_tiny()), typical_question(101, 20)
    roi = np.zeros((180, 320), np.bool_)
    roi[60:110, 100:200] = True
    nothing = LisaOptions(image_tokens="all", clip_patches="all", sam_padding="keep", sam_windows="all")
    chosen = {
        "image_tokens": LisaOptions(image_tokens="drop", sam_padding="keep", sam_windows="all"),
        "clip_patches": LisaOptions(image_tokens="drop", clip_patches="drop", sam_padding="keep", sam_windows="all"),
        "sam_windows": LisaOptions(image_tokens="all", sam_windows="skip"),
    }[switch]
    lowered = {
        "image_tokens": {"prefill", "projector"},
        "clip_patches": {"clip", "prefill", "projector"},
        "sam_windows": {"sam_encoder", "mask_decoder"},
    }[switch]
    before = count_forced(shapes, blank_frame(shapes, (180, 320), roi, nothing), question)
    after = count_forced(
        shapes,
        blank_frame(shapes, (180, 320), roi, chosen),
        question,
        clip_patches=chosen.clip_patches == "drop",
    )
    stages = ("clip", "projector", "prefill", "decode", "lm_head", "sam_encoder", "mask_decoder")
    assert {stage for stage in stages if getattr(after, stage) < getattr(before, stage)} == lowered
    assert all(getattr(after, stage) <= getattr(before, stage) for stage in stages)
    assert after.total == sum(getattr(after, stage) for stage in stages)


def test_an_answer_token_more_costs_the_original_a_pass_and_a_cache_a_step() -> None:
    shapes, question = meta_lisa(lisa_tiny()), typical_question(101, 20)
    longer = Question(question.ids, (*question.answer[:-1], 6, question.answer[-1]), question.tokens)
    frame = blank_frame(shapes, (180, 320), None, PLAIN)
    llama = shapes.architecture.llama
    image_tokens, spoken = 16, 5
    original = count_original(shapes, frame, longer).decode - count_original(shapes, frame, question).decode
    assert original == prefill_flops(llama, 20 + image_tokens + spoken)
    cached = count_generated(shapes, frame, longer).decode - count_generated(shapes, frame, question).decode
    attended = 20 + image_tokens + spoken
    # One token's products with every weight, and with the keys and values of all before it and its own.
    assert cached == prefill_flops(llama, 1) + 4 * 2 * 64 * (attended - 1)
