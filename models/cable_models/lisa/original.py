"""One frame the way the published code runs it, for comparison: no cache, and CLIP again for every token.

Source: dvlab-research/LISA, branch ``lisa_plus``, ``model/LISA.py``. The operations are the published ones; the
kernels are those of the installed torch and transformers.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import torch

from cable_models.errors import ModelError
from cable_models.lisa.clip_tower import project
from cable_models.lisa.language import ImageTokens, forward, segmentation_embeddings, splice
from cable_models.lisa.mask_decoder import decode_masks
from cable_models.lisa.model import LisaModel
from cable_models.lisa.sam_encoder import encode
from cable_models.lisa.special_tokens import SpecialTokens


class Stages(Protocol):
    """What measures the stages of a frame: their time or their operations."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Measures what runs inside."""


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked of a frame, and what the answer is."""

    ids: tuple[int, ...]
    """Prompt with the image placeholder."""
    answer: tuple[int, ...]
    """With its [SEG] and its end token."""
    tokens: SpecialTokens

    @property
    def masks(self) -> int:
        """Masks that the answer asks for."""
        return self.answer.count(self.tokens.seg)


def typical_question(vocabulary: int, text_tokens: int = 94) -> Question:
    """A prompt of meaningless words as long as a real one, and an answer as long as "Sure, [SEG].".

    Args:
        vocabulary: Rows of the embedding table; [SEG] is the last one.
        text_tokens: Tokens beside the image; 94 are a long question with the suffix for instances.

    Raises:
        ModelError: no room for such a prompt.
    """
    if vocabulary < 8 or text_tokens < 2:
        raise ModelError(f"a question of {text_tokens} tokens from {vocabulary} words; 2 tokens and 8 words are least")
    tokens = SpecialTokens(seg=vocabulary - 1)
    words = [3 + number * 7919 % (vocabulary - 4) for number in range(text_tokens - 1)]
    before = min(33, len(words))
    ids = (tokens.bos, *words[:before], tokens.image_placeholder, *words[before:])
    return Question(ids, (3, 4, tokens.seg, 5, tokens.eos), tokens)


@torch.inference_mode()
def original_frame(
    model: LisaModel, clip_pixels: torch.Tensor, sam_pixels: torch.Tensor, question: Question, stages: Stages
) -> torch.Tensor:
    """Decodes one whole frame; stages clip, projector, prefill, decode, lm_head, sam_encoder and mask_decoder.

    Every token of the answer runs all blocks of CLIP, the projector, the language model on the whole sequence and
    its head on all positions. The next token is the given answer's, whatever the head says.

    Args:
        model: The network.
        clip_pixels: float [1, 3, S, S].
        sam_pixels: float [1, 3, S, S].
        question: Prompt and answer.
        stages: Measures; ``prefill`` is the first pass of the language model, ``decode`` the ones that follow.

    Returns:
        Low-resolution logits [n_seg, rows, columns].
    """
    placeholder = question.tokens.image_placeholder
    states = []
    for spoken, token in enumerate(question.answer):
        with stages.stage("clip"):
            tower = model.vision_tower(clip_pixels.to(model.dtype), output_hidden_states=True)
            features = tower.hidden_states[model.architecture.select_layer][:, 1:]
        with stages.stage("projector"):
            image = project(model, list(features))[0]
        with stages.stage("decode" if spoken else "prefill"):
            ids = [*question.ids, *question.answer[:spoken]]
            prompt = splice(model, ids, ImageTokens(image, None, len(image)), placeholder, compact=True)
            hidden = forward(model, prompt.embeddings[None], prompt.positions[None])[0]
        with stages.stage("lm_head"):
            model.lm_head(hidden).argmax(-1)
        if token == question.tokens.seg:
            states.append(hidden[-1])
    return original_masks(model, sam_pixels, torch.stack(states), stages)


def original_masks(model: LisaModel, sam_pixels: torch.Tensor, states: torch.Tensor, stages: Stages) -> torch.Tensor:
    """SAM on the whole frame, one mask for each of the states [n_seg, width] before a [SEG]."""
    with stages.stage("sam_encoder"):
        features = encode(model.sam.vision_encoder, sam_pixels.to(model.dtype))
    with stages.stage("mask_decoder"):
        return decode_masks(model.sam, features, [segmentation_embeddings(model, states)])[0]
