"""LISA++'s language side: image tokens spliced into the prompt, one causal pass, the states that precede [SEG]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch.nn.utils.rnn import pad_sequence
from transformers import Cache

from cable_models.errors import ModelError
from cable_models.lisa.compiled import decoder_stack
from cable_models.lisa.model import LisaModel


@dataclass(frozen=True, slots=True)
class ImageTokens:
    """The visual part of one frame's prompt."""

    features: torch.Tensor
    """[n_kept, width], after the projector, row by row from the top left."""
    numbers: torch.Tensor | None
    """int64 [n_kept], row-major numbers of the kept tokens in the whole grid; None = all of them."""
    whole: int
    """Tokens of a whole frame."""


@dataclass(frozen=True, slots=True)
class SplicedPrompt:
    """A prompt ready for the language model."""

    embeddings: torch.Tensor
    """[n, width]."""
    positions: torch.Tensor
    """int64 [n], rotary position of each token."""
    next_position: int
    """Position of the token that follows."""
    placeholder: int
    """Index of the image placeholder in the ids."""
    image_tokens: int
    """Visual tokens that took the placeholder's place."""

    def index_of(self, id_index: int) -> int:
        """Where the token ``id_index`` of the ids (not the placeholder) stands in the spliced sequence."""
        return id_index if id_index < self.placeholder else id_index + self.image_tokens - 1


def splice(
    model: LisaModel, ids: Sequence[int], image: ImageTokens, placeholder: int, *, compact: bool
) -> SplicedPrompt:
    """Puts the image tokens in the place of the placeholder.

    Tokens keep the rotary positions that they have in the whole prompt, so that dropping some of them leaves the
    distances between the others as they were (pruned LLaVA loses its grounding otherwise: arXiv 2506.21873).

    Args:
        model: The network.
        ids: Token ids with one placeholder.
        image: Its visual tokens.
        placeholder: Id that stands for the image.
        compact: Positions 0..n-1 instead, as if the dropped tokens had never been.

    Raises:
        ModelError: no placeholder, or several.
    """
    if ids.count(placeholder) != 1:
        raise ModelError(
            f"a prompt needs exactly one image placeholder ({placeholder}), this one of {len(ids)} ids has "
            f"{ids.count(placeholder)}"
        )
    at = ids.index(placeholder)
    text = torch.tensor([*ids[:at], *ids[at + 1 :]], device=model.device)
    embedded = model.language_model.get_input_embeddings()(text)
    embeddings = torch.cat([embedded[:at], image.features.to(embedded.dtype), embedded[at:]])
    if compact or image.numbers is None:
        positions = torch.arange(len(embeddings), device=model.device)
        return SplicedPrompt(embeddings, positions, len(embeddings), at, len(image.features))
    after = torch.arange(at + image.whole, len(ids) - 1 + image.whole, device=model.device)
    before = torch.arange(at, device=model.device)
    positions = torch.cat([before, at + image.numbers, after])
    return SplicedPrompt(embeddings, positions, len(ids) - 1 + image.whole, at, len(image.features))


def hidden_states(model: LisaModel, prompts: Sequence[SplicedPrompt], bucket: int = 0) -> list[torch.Tensor]:
    """Hidden states after the final norm, [n, width] for each prompt, of one batched pass without a cache.

    Prompts of different length are padded at their right, which a causal model never looks at: no mask is needed
    and the attention kernel stays the plain causal one.

    Args:
        model: The network.
        prompts: One for each frame.
        bucket: Length is rounded up to a multiple, for compiled graphs of few shapes; 0 = not at all.
    """
    lengths = [len(prompt.embeddings) for prompt in prompts]
    padded = pad_sequence([prompt.embeddings for prompt in prompts], batch_first=True)
    positions = pad_sequence([prompt.positions for prompt in prompts], batch_first=True)
    if bucket:
        surplus = -padded.shape[1] % bucket
        padded = torch.nn.functional.pad(padded, (0, 0, 0, surplus))
        positions = torch.nn.functional.pad(positions, (0, surplus))
    hidden = forward(model, padded, positions)
    return [row[:length] for row, length in zip(hidden, lengths, strict=True)]


def forward(
    model: LisaModel, embeddings: torch.Tensor, positions: torch.Tensor, cache: Cache | None = None
) -> torch.Tensor:
    """One pass of the language model, [B, n, width] to hidden states after the final norm [B, n, width].

    Args:
        model: The network.
        embeddings: [B, n, width]; n is 1 where the cache holds anything.
        positions: int64 [B, n], rotary positions, gaps allowed.
        cache: Keys and values of the tokens before; grows by these.
    """
    if cache is None:
        return model.stacks.language(model.language_model, embeddings, positions)
    return decoder_stack(model.language_model, embeddings, positions, cache)


def source_indices(ids: Sequence[int], prompt: SplicedPrompt, seg: int) -> list[int]:
    """Where the states that make the [SEG] embeddings stand in the spliced sequence: just before each [SEG].

    Raises:
        ModelError: a [SEG] opens the prompt or directly follows the image, so that no state of text precedes it.
    """
    found = [index for index, token in enumerate(ids) if token == seg]
    if any(index < 1 for index in found):
        raise ModelError("a [SEG] token opens the prompt; there is no state before it to read a mask from")
    return [prompt.index_of(index) - 1 for index in found]


def segmentation_embeddings(model: LisaModel, states: torch.Tensor) -> torch.Tensor:
    """Prompts for the mask decoder, [n_seg, out_dim], of the states before each [SEG], [n_seg, width]."""
    prompts: torch.Tensor = model.text_hidden_fcs(states)
    return prompts
