"""What the ROI switches leave as it was, and what they compute of the rest."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch
from cable_models import ModelError
from cable_models.lisa import FrameAnswer, FrameRequest, LisaOptions, LisaPipeline, LoadedLisa
from cable_models.lisa.language import ImageTokens, forward, hidden_states, splice
from cable_models.lisa.options import PLAIN

PROMPT = (1, 5, 6, 7, -200, 8, 9, 10, 11)
ANSWER = (12, 13, 59, 14, 59, 2)
FORCED = replace(PLAIN, decoding="forced", forced_ids=ANSWER, verify_frames=0)
SWITCHES = {
    "image_tokens=drop": {"image_tokens": "drop"},
    "image_tokens=compact": {"image_tokens": "compact"},
    "clip_patches=drop": {"image_tokens": "drop", "clip_patches": "drop"},
    "sam_padding=drop": {"sam_padding": "drop"},
    "sam_windows=skip": {"sam_windows": "skip"},
    "sam_windows=tokens": {"sam_windows": "tokens"},
    "all of them": {
        "image_tokens": "drop",
        "clip_patches": "drop",
        "sam_padding": "drop",
        "sam_windows": "skip",
    },
}


def frame(height: int, width: int, seed: int = 3) -> npt.NDArray[np.uint8]:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def corridor(height: int, width: int) -> npt.NDArray[np.bool_]:
    roi = np.zeros((height, width), np.bool_)
    roi[height // 2 : height // 2 + height // 5, width // 3 : width // 3 + width // 4] = True
    return roi


def answer(loaded: LoadedLisa, options: LisaOptions, roi: npt.NDArray[np.bool_] | None) -> FrameAnswer:
    height, width = (90, 160) if roi is None else roi.shape
    return LisaPipeline(loaded, options).segment([FrameRequest(frame(height, width), roi, PROMPT)])[0]


@pytest.mark.parametrize("fit", ["crop", "pad", "squash"])
@pytest.mark.parametrize("switch", SWITCHES.values(), ids=list(SWITCHES))
@pytest.mark.parametrize("size", [(90, 160), (160, 90)], ids=["landscape", "portrait"])
def test_full_region_changes_no_bit(
    tiny_lisa: LoadedLisa, switch: dict[str, str], fit: str, size: tuple[int, int]
) -> None:
    plain = replace(FORCED, clip_fit=fit)
    whole = np.ones(size, np.bool_)
    expected = answer(tiny_lisa, plain, whole)
    assert 0.02 < expected.masks.mean() < 0.98
    found = answer(tiny_lisa, replace(plain, **switch), whole)
    assert np.array_equal(found.mask_logits, expected.mask_logits)
    assert found.prefill.image_tokens == found.prefill.whole_image_tokens == 25


@pytest.mark.parametrize("switch", SWITCHES.values(), ids=list(SWITCHES))
def test_small_region_leaves_out_work_and_keeps_a_mask(tiny_lisa: LoadedLisa, switch: dict[str, str]) -> None:
    roi = corridor(90, 160)
    found = answer(tiny_lisa, replace(FORCED, **switch), roi)
    assert np.isfinite(found.mask_logits).all()
    if "image_tokens" in switch:
        assert 0 < found.prefill.image_tokens < 25
        assert found.prefill.speedup_quadratic > found.prefill.speedup_flops > 1
    if switch.get("sam_windows"):
        assert (found.mask_logits[:, :, -8:] == -32).all()


def test_dropped_tokens_are_as_if_nobody_attended_to_them(tiny_lisa: LoadedLisa) -> None:
    model = tiny_lisa.model
    features = torch.randn(25, 48, generator=torch.Generator().manual_seed(1))
    kept = torch.tensor([3, 4, 9, 17])
    whole = splice(model, PROMPT, ImageTokens(features, None, 25), -200, compact=False)
    part = splice(model, PROMPT, ImageTokens(features[kept], kept, 25), -200, compact=False)
    stays = torch.ones(33, dtype=torch.bool)
    stays[4:29] = False
    stays[4 + kept] = True
    visible = torch.ones(33, 33, dtype=torch.bool).tril() & (stays | torch.eye(33, dtype=torch.bool))
    mask = torch.zeros(33, 33).masked_fill(~visible, float("-inf"))[None, None]
    literal = model.language_model(inputs_embeds=whole.embeddings[None], attention_mask=mask, use_cache=False)
    dropped = forward(model, part.embeddings[None], part.positions[None])[0]
    torch.testing.assert_close(dropped, literal.last_hidden_state[0, stays], atol=1e-5, rtol=1e-5)
    assert part.positions.tolist() == torch.arange(33)[stays].tolist()


def test_compact_positions_are_those_of_a_shorter_prompt(tiny_lisa: LoadedLisa) -> None:
    features = torch.randn(4, 48, generator=torch.Generator().manual_seed(1))
    kept = torch.tensor([3, 4, 9, 17])
    part = splice(tiny_lisa.model, PROMPT, ImageTokens(features, kept, 25), -200, compact=True)
    literal = tiny_lisa.model.language_model(inputs_embeds=part.embeddings[None], use_cache=False)
    torch.testing.assert_close(hidden_states(tiny_lisa.model, [part])[0], literal.last_hidden_state[0])


@pytest.mark.parametrize("options", [FORCED, replace(FORCED, **SWITCHES["all of them"])], ids=["plain", "switches"])
@pytest.mark.parametrize("bucket", [0, 16])
def test_batch_gives_what_its_frames_give_alone(tiny_lisa: LoadedLisa, options: LisaOptions, bucket: int) -> None:
    options = replace(options, token_bucket=bucket)
    wide, tall = corridor(90, 160), corridor(150, 110)
    requests = [
        FrameRequest(frame(90, 160), wide, PROMPT, "a"),
        FrameRequest(frame(90, 160, seed=4), None, PROMPT, "b"),
        FrameRequest(frame(150, 110), tall, (*PROMPT, 15, 16, 17), "c"),
        FrameRequest(frame(90, 160, seed=5), np.roll(wide, 30, axis=1), PROMPT, "d"),
    ]
    together = LisaPipeline(tiny_lisa, options).segment(requests)
    for request, batched in zip(requests, together, strict=True):
        (alone,) = LisaPipeline(tiny_lisa, replace(options, token_bucket=0)).segment([request])
        assert batched.batch_size == 4
        assert batched.prefill.image_tokens == alone.prefill.image_tokens
        scale = np.abs(alone.mask_logits).max()
        np.testing.assert_allclose(batched.mask_logits, alone.mask_logits, atol=2e-5 * scale, rtol=0)


def test_region_that_clip_does_not_see_keeps_all_its_tokens(tiny_lisa: LoadedLisa) -> None:
    roi = np.zeros((90, 160), np.bool_)
    roi[40:60, :8] = True
    assert answer(tiny_lisa, replace(FORCED, image_tokens="drop"), roi).prefill.image_tokens == 25
    squashed = replace(FORCED, image_tokens="drop", clip_fit="squash")
    assert answer(tiny_lisa, squashed, roi).prefill.image_tokens == 2


def test_empty_region_is_answered(tiny_lisa: LoadedLisa) -> None:
    found = answer(tiny_lisa, replace(FORCED, **SWITCHES["all of them"]), np.zeros((90, 160), np.bool_))
    assert not found.masks.any()


def test_measured_prefill_stands_beside_that_of_whole_frames(tiny_lisa: LoadedLisa) -> None:
    pipeline = LisaPipeline(tiny_lisa, replace(FORCED, image_tokens="drop"))
    roi = corridor(90, 160)
    before = pipeline.segment([FrameRequest(frame(90, 160), roi, PROMPT)])[0].prefill
    pipeline.segment([FrameRequest(frame(90, 160), None, PROMPT)])
    after = pipeline.segment([FrameRequest(frame(90, 160), roi, PROMPT)])[0].prefill
    assert before.whole_ns == 0
    assert before.measured_ns > 0
    assert after.whole_ns > 0


@pytest.mark.parametrize(
    ("image", "roi", "prompt", "message"),
    [
        (np.zeros((8, 8), np.uint8), None, PROMPT, "uint8"),
        (np.zeros((8, 8, 3), np.uint8), np.ones((8, 9), np.bool_), PROMPT, "region must be bool"),
        (np.zeros((8, 8, 3), np.uint8), None, (1, 2, 3), "exactly one image placeholder"),
        (np.zeros((8, 8, 3), np.uint8), None, (1, -200, 60), "60"),
        (np.zeros((8, 8, 3), np.uint8), None, "Where is the car?", "tokenizer"),
    ],
)
def test_bad_input_is_refused(
    tiny_lisa: LoadedLisa, image: npt.NDArray[np.uint8], roi: npt.NDArray[np.bool_] | None, prompt: object, message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        LisaPipeline(tiny_lisa, FORCED).segment([FrameRequest(image, roi, prompt)])  # type: ignore[arg-type]
