"""How an answer with [SEG] tokens comes about: generated token by token, or given and checked in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from transformers import DynamicCache

from cable_models.lisa.language import (
    ImageTokens,
    SplicedPrompt,
    forward,
    hidden_states,
    source_indices,
    splice,
)
from cable_models.lisa.model import LisaModel
from cable_models.lisa.special_tokens import SpecialTokens
from cable_models.lisa.stage_timer import StageTimer


@dataclass(frozen=True, slots=True)
class Answer:
    """What the language model says, and the states that its masks come from."""

    ids: tuple[int, ...]
    """Token ids of the answer, with the end token where it was reached or given."""
    states: torch.Tensor
    """[n_seg, width], the hidden state before each [SEG] of prompt and answer."""
    forced: bool
    """Whether it was given rather than generated."""
    agrees: bool | None = None
    """Whether greedy decoding says what was to be forced on this frame; None = not checked."""


@torch.inference_mode()
def generate(
    model: LisaModel,
    tokens: SpecialTokens,
    ids: Sequence[int],
    image: ImageTokens,
    *,
    max_new_tokens: int,
    compact: bool,
    timer: StageTimer,
    use_cache: bool = True,
) -> Answer:
    """Greedy decoding until the end token, stages ``prefill`` (the first pass) and ``decode`` (the rest).

    Args:
        model: The network.
        tokens: Its special tokens.
        ids: Prompt with the image placeholder.
        image: Visual tokens.
        max_new_tokens: Longest answer.
        compact: See `language.splice`.
        timer: Takes the durations.
        use_cache: Keys and values are kept; False runs the whole sequence again for every token.
    """
    answer: list[int] = []
    spoken: list[torch.Tensor] = []
    with timer.stage("prefill"):
        prompt = splice(model, ids, image, tokens.image_placeholder, compact=compact)
        cache = DynamicCache(config=model.language_model.config) if use_cache else None
        hidden = forward(model, prompt.embeddings[None], prompt.positions[None], cache)[0]
        in_prompt = hidden[source_indices(ids, prompt, tokens.seg)]
        state = hidden[-1]
        token = int(model.lm_head(state).argmax())
    with timer.stage("decode"):
        while True:
            answer.append(token)
            if token == tokens.seg:
                spoken.append(state)
            if token == tokens.eos or len(answer) >= max_new_tokens:
                break
            state = next_state(model, prompt, answer, cache)
            token = int(model.lm_head(state).argmax())
    states = torch.stack(spoken) if spoken else in_prompt[:0]
    return Answer(tuple(answer), torch.cat([in_prompt, states]), forced=False)


def next_state(
    model: LisaModel, prompt: SplicedPrompt, answer: Sequence[int], cache: DynamicCache | None
) -> torch.Tensor:
    """Hidden state [width] of the answer's last token: of that token alone with a cache, of everything without."""
    fresh = answer[-1:] if cache is not None else answer
    embedded = model.language_model.get_input_embeddings()(torch.tensor(fresh, device=model.device))
    first = prompt.next_position + len(answer) - len(fresh)
    positions = torch.arange(first, first + len(fresh), device=model.device)
    if cache is None:
        embedded = torch.cat([prompt.embeddings, embedded])
        positions = torch.cat([prompt.positions, positions])
    return forward(model, embedded[None], positions[None], cache)[0, -1]


@dataclass(frozen=True, slots=True)
class ForcedPrompt:
    """A frame's prompt with the answer that it is made to give."""

    ids: tuple[int, ...]
    """Prompt with the image placeholder."""
    answer: tuple[int, ...]
    image: ImageTokens
    verify: bool
    """Whether the answer is compared with what greedy decoding would say."""


@torch.inference_mode()
def force(
    model: LisaModel,
    tokens: SpecialTokens,
    prompts: Sequence[ForcedPrompt],
    *,
    compact: bool,
    timer: StageTimer,
    bucket: int = 0,
) -> list[Answer]:
    """Given answers in one pass over all prompts, stage ``prefill``; without the language head unless verified.

    Under teacher forcing, greedy decoding says the same answer exactly where each of its tokens has the largest
    logit after those before it: one pass tells what token-by-token generation would.

    Args:
        model: The network.
        tokens: Its special tokens.
        prompts: One for each frame, of any lengths.
        compact: See `language.splice`.
        timer: Takes the duration.
        bucket: See `language.hidden_states`.
    """
    with timer.stage("prefill"):
        ids = [used_ids(prompt, tokens.seg) for prompt in prompts]
        spliced = [
            splice(model, text, prompt.image, tokens.image_placeholder, compact=compact)
            for text, prompt in zip(ids, prompts, strict=True)
        ]
        hidden = hidden_states(model, spliced, bucket)
        return [
            Answer(
                prompt.answer,
                states[source_indices([*text, *next_seg(prompt, text)], sequence, tokens.seg)],
                forced=True,
                agrees=says(model, prompt, states, sequence) if prompt.verify else None,
            )
            for prompt, text, sequence, states in zip(prompts, ids, spliced, hidden, strict=True)
        ]


def used_ids(prompt: ForcedPrompt, seg: int) -> list[int]:
    """The ids that are run: up to the token before the last [SEG], or all but the last to verify them all."""
    everything = [*prompt.ids, *prompt.answer]
    if prompt.verify or seg not in everything:
        return everything[:-1]
    return everything[: len(everything) - 1 - everything[::-1].index(seg)]


def next_seg(prompt: ForcedPrompt, used: Sequence[int]) -> list[int]:
    """The id that follows those that are run; it may be the last [SEG]."""
    everything = [*prompt.ids, *prompt.answer]
    return everything[len(used) : len(used) + 1]


def says(model: LisaModel, prompt: ForcedPrompt, states: torch.Tensor, sequence: SplicedPrompt) -> bool:
    """Whether each token of the answer is the likeliest one after those before it."""
    before_answer = sequence.index_of(len(prompt.ids)) - 1
    logits = model.lm_head(states[before_answer : before_answer + len(prompt.answer)])
    return bool(torch.equal(logits.argmax(-1), torch.tensor(prompt.answer, device=logits.device)))
