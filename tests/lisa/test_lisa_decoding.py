"""Forced answers against greedy decoding, and when a stream changes from one to the other."""

from __future__ import annotations

import pytest
import torch
from cable_models import ModelError
from cable_models.lisa import LisaOptions, LisaPipeline, LoadedLisa
from cable_models.lisa.decoding import Answer, ForcedPrompt, force, generate
from cable_models.lisa.language import ImageTokens
from cable_models.lisa.stage_timer import StageTimer
from cable_models.lisa.stream_decoding import StreamDecoding

SEG, EOS = 59, 2
CPU = torch.device("cpu")


def image(seed: int, kept: list[int] | None = None) -> ImageTokens:
    features = torch.randn(25, 48, generator=torch.Generator().manual_seed(seed))
    numbers = None if kept is None else torch.tensor(kept)
    return ImageTokens(features if numbers is None else features[numbers], numbers, 25)


def greedy(loaded: LoadedLisa, prompt: tuple[int, ...], seen: ImageTokens, *, use_cache: bool = True) -> Answer:
    return generate(
        loaded.model,
        loaded.tokens,
        prompt,
        seen,
        max_new_tokens=12,
        compact=False,
        timer=StageTimer(CPU),
        use_cache=use_cache,
    )


def forced(loaded: LoadedLisa, prompt: tuple[int, ...], answer: tuple[int, ...], seen: ImageTokens) -> Answer:
    given = ForcedPrompt(prompt, answer, seen, verify=True)
    return force(loaded.model, loaded.tokens, [given], compact=False, timer=StageTimer(CPU))[0]


@pytest.mark.parametrize("kept", [None, [2, 3, 11, 24]], ids=["whole", "dropped"])
@pytest.mark.parametrize("seed", range(4))
def test_cache_changes_nothing(tiny_lisa: LoadedLisa, seed: int, kept: list[int] | None) -> None:
    prompt = (1, 3 + seed, 7, -200, 9, 10 + seed)
    cached, uncached = (greedy(tiny_lisa, prompt, image(seed, kept), use_cache=cache) for cache in (True, False))
    assert cached.ids == uncached.ids
    torch.testing.assert_close(cached.states, uncached.states, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kept", [None, [0, 6, 7, 20]], ids=["whole", "dropped"])
@pytest.mark.parametrize("seed", range(4))
def test_one_forced_pass_tells_what_greedy_decoding_says(
    tiny_lisa: LoadedLisa, seed: int, kept: list[int] | None
) -> None:
    prompt, seen = (1, 30 + seed, -200, 9, 8), image(seed, kept)
    own = greedy(tiny_lisa, prompt, seen).ids
    assert forced(tiny_lisa, prompt, own, seen).agrees is True
    for place in range(len(own)):
        other = (*own[:place], (own[place] + 1) % 59, *own[place + 1 :])
        assert forced(tiny_lisa, prompt, other, seen).agrees is False


def test_a_prompt_may_end_with_the_image(tiny_lisa: LoadedLisa) -> None:
    prompt, seen = (1, 5, -200), image(0)
    assert forced(tiny_lisa, prompt, greedy(tiny_lisa, prompt, seen).ids, seen).agrees is True


def test_states_of_seg_tokens_are_those_before_them_wherever_the_answer_ends(tiny_lisa: LoadedLisa) -> None:
    prompt, seen = (1, 4, -200, 9), image(1)
    checked = forced(tiny_lisa, prompt, (12, SEG, 13, SEG, 14, EOS), seen)
    blind = force(
        tiny_lisa.model,
        tiny_lisa.tokens,
        [ForcedPrompt(prompt, (12, SEG, 13, SEG), seen, verify=False)],
        compact=False,
        timer=StageTimer(CPU),
    )[0]
    assert checked.states.shape == (2, 48)
    torch.testing.assert_close(blind.states, checked.states, atol=1e-5, rtol=1e-5)


def test_answer_is_trusted_after_its_checks_and_looked_at_again_now_and_then() -> None:
    stream = StreamDecoding(LisaOptions(verify_frames=2, verify_interval=5), (12, SEG, EOS))
    checked = []
    for _ in range(11):
        step = stream.next_step()
        assert step.answer == (12, SEG, EOS)
        checked.append(step.verify)
        stream.agreed(True if step.verify else None)
    assert [index for index, verify in enumerate(checked) if verify] == [0, 1, 5, 10]


def test_refused_answer_is_replaced_by_the_models_own_until_that_fails_too_often() -> None:
    stream = StreamDecoding(LisaOptions(max_disagreements=2), (12, SEG, EOS))
    stream.agreed(False)
    assert stream.next_step().answer is None
    stream.generated((20, SEG, EOS), SEG)
    assert stream.next_step().answer == (20, SEG, EOS)
    assert stream.next_step().verify
    stream.agreed(False)
    stream.generated((21, SEG, EOS), SEG)
    assert stream.next_step().answer is None


def test_answer_without_a_mask_is_not_forced() -> None:
    stream = StreamDecoding(LisaOptions(), None)
    stream.generated((20, EOS), SEG)
    assert stream.next_step().answer is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_patches": "drop", "image_tokens": "all"}, "image_tokens"),
        ({"min_patch_overlap": 1.5}, "0..1"),
        ({"verify_frames": -1}, "verify_frames"),
        ({"max_new_tokens": 0}, "max_new_tokens"),
    ],
)
def test_contradictory_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        LisaOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("ids", [(12, EOS), (SEG, 60)], ids=["no mask", "beyond the vocabulary"])
def test_forced_ids_must_make_a_mask(tiny_lisa: LoadedLisa, ids: tuple[int, ...]) -> None:
    with pytest.raises(ModelError, match="forced_ids"):
        LisaPipeline(tiny_lisa, LisaOptions(forced_ids=ids))
