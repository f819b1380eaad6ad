"""The language half of the compact LISA under training: CLIP, projector and Llama learn what to say at [SEG]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from transformers import CLIPVisionConfig, LlamaConfig

from cable_models.detection import Image
from cable_models.lisa.architecture import ClipPreprocessing, LisaArchitecture
from cable_models.lisa.clip_tower import patch_features, project
from cable_models.lisa.images import clip_geometry, clip_input
from cable_models.lisa.language import ImageTokens, hidden_states, segmentation_embeddings, splice
from cable_models.lisa.model import LisaModel
from cable_models.lisa.prompt import build_prompt, forced_answer_ids
from cable_models.lisa.special_tokens import SpecialTokens
from cable_models.lisa.tokenizer import LisaTokenizer
from cable_models.training.segmentation_encoder import spread_weights, wave_filters
from cable_models.training.segmentation_prompts import ANSWER, OTHER_ANSWERS, Question, draw_question
from cable_models.training.segmentation_samples import CLASS_NAMES, SegmentedImage
from cable_models.training.segmentation_views import class_shares
from cable_models.training.segmentation_vision import CompactSamConfig


@dataclass(frozen=True, slots=True)
class CompactLisaConfig:
    """Sizes of the compact LISA."""

    sam: CompactSamConfig = field(default_factory=CompactSamConfig)
    clip_image: int = 112
    clip_patch: int = 14
    clip_width: int = 96
    clip_layers: int = 4
    clip_heads: int = 4
    llama_width: int = 128
    llama_layers: int = 3
    llama_heads: int = 4
    llama_mlp: int = 344
    max_length: int = 512

    def architecture(self, vocabulary: int) -> LisaArchitecture:
        """The sizes of all parts, for a tokenizer of ``vocabulary`` ids."""
        return LisaArchitecture(
            llama=LlamaConfig(
                vocab_size=vocabulary,
                hidden_size=self.llama_width,
                intermediate_size=self.llama_mlp,
                num_hidden_layers=self.llama_layers,
                num_attention_heads=self.llama_heads,
                num_key_value_heads=self.llama_heads,
                max_position_embeddings=self.max_length,
                rms_norm_eps=1e-5,
                tie_word_embeddings=False,
                pad_token_id=None,
            ),
            clip=CLIPVisionConfig(
                hidden_size=self.clip_width,
                intermediate_size=4 * self.clip_width,
                num_hidden_layers=self.clip_layers,
                num_attention_heads=self.clip_heads,
                image_size=self.clip_image,
                patch_size=self.clip_patch,
            ),
            sam=self.sam.sam_config(),
            projector="mlp2x_gelu",
            select_layer=-2,
            select_feature="patch",
            out_dim=self.sam.channels,
        )


class LanguageTrainee(nn.Module):
    """A whole LISA with a head that teaches its CLIP tower to see classes; SAM is not touched."""

    def __init__(self, config: CompactLisaConfig, tokenizer: LisaTokenizer, tokens: SpecialTokens) -> None:
        super().__init__()
        self.lisa = LisaModel(config.architecture(tokenizer.vocabulary_size))
        self.see = nn.Linear(config.llama_width, 1 + len(CLASS_NAMES))
        self.tokenizer = tokenizer
        self.tokens = tokens
        self.lisa.sam.requires_grad_(False)
        initialise_language(self.lisa)

    def image_tokens(self, pixels: Tensor) -> list[Tensor]:
        """Projected image tokens [n, width] of each picture of CLIP pixels [N, 3, S, S]."""
        return list(project(self.lisa, list(patch_features(self.lisa, pixels))))

    def states(self, images: Sequence[Tensor], asked: Sequence[tuple[list[int], list[int]]]) -> list[Tensor]:
        """Hidden states [n, width] of prompt and answer, one picture and one pair of ids each."""
        prompts = [
            splice(
                self.lisa,
                [*prompt, *answer],
                ImageTokens(image, None, len(image)),
                self.tokens.image_placeholder,
                compact=False,
            )
            for image, (prompt, answer) in zip(images, asked, strict=True)
        ]
        return hidden_states(self.lisa, prompts)

    def seg_token(self, states: Tensor, ids: Sequence[int], image_tokens: int) -> Tensor:
        """The mask decoder's prompt [out_dim] of the first [SEG] among the ids of prompt and answer."""
        at = ids.index(self.tokens.seg) + image_tokens - 2
        return segmentation_embeddings(self.lisa, states[at : at + 1])[0]

    def ask(self, question: Question, answer: str) -> tuple[list[int], list[int]]:
        """Ids of prompt and answer."""
        prompt = build_prompt(question.text, question.mode, question.system)
        return self.tokenizer.encode_prompt(prompt), forced_answer_ids(self.tokenizer, answer, self.tokens.seg)


def initialise_language(lisa: LisaModel) -> None:
    """Weights from which the language half learns within minutes."""
    spread_weights(lisa.vision_tower)
    spread_weights(lisa.language_model)
    spread_weights(lisa.mm_projector)
    spread_weights(lisa.text_hidden_fcs)
    for name, weight in lisa.vision_tower.named_parameters():
        if name.endswith("patch_embedding.weight"):
            with torch.no_grad():
                weight.copy_(wave_filters(weight.shape[0], weight.shape[2]))


@dataclass(frozen=True, slots=True)
class LanguageBatch:
    """Pictures, one question each."""

    pixels: Tensor
    """float32 [N, 3, S, S], CLIP's input."""
    shares: Tensor
    """float32 [N, 4, patches, patches], share of each class under a patch."""
    questions: tuple[Question, ...]
    answers: tuple[str, ...]


def language_batch(
    samples: Sequence[SegmentedImage], clip_image: int, clip_patch: int, rng: np.random.Generator
) -> LanguageBatch:
    """Questions about pictures; three in four answers are the one that the model is to learn."""
    pixels, shares = [], []
    side = clip_image // clip_patch
    for sample in samples:
        height, width = sample.image.shape[:2]
        edge = min(height, width)
        part = (slice((height - edge) // 2, (height + edge) // 2), slice((width - edge) // 2, (width + edge) // 2))
        square = SegmentedImage(
            np.ascontiguousarray(sample.image[part]), np.ascontiguousarray(sample.instances[part]), sample.table
        )
        pixels.append(clip_pixels(square.image, clip_image))
        shares.append(class_shares(square, (side, side)))
    answers = tuple(str(rng.choice(OTHER_ANSWERS)) if rng.random() < 0.25 else ANSWER for _ in samples)
    return LanguageBatch(
        torch.from_numpy(np.stack(pixels)),
        torch.from_numpy(np.stack(shares)),
        tuple(draw_question(rng) for _ in samples),
        answers,
    )


def clip_pixels(image: Image, size: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """CLIP's input of a picture, float32 [3, size, size]."""
    geometry = clip_geometry((image.shape[0], image.shape[1]), size, "crop")
    statistics = ClipPreprocessing(size)
    return clip_input(image, geometry, statistics.mean, statistics.std)


def language_loss(trainee: LanguageTrainee, batch: LanguageBatch, concept_tokens: Tensor) -> dict[str, Tensor]:
    """How far the prompt said at [SEG] is from the concept's, how unlikely the answer, how blind the CLIP tower.

    Args:
        trainee: The model.
        batch: N questions.
        concept_tokens: [concepts, out_dim], what is to be said.
    """
    images = trainee.image_tokens(batch.pixels)
    asked = [trainee.ask(*pair) for pair in zip(batch.questions, batch.answers, strict=True)]
    states = trainee.states(images, asked)
    said, logits, targets = [], [], []
    for row, (prompt, answer), image, text in zip(states, asked, images, batch.answers, strict=True):
        said.append(trainee.seg_token(row, [*prompt, *answer], len(image)))
        if text == ANSWER:
            first = len(prompt) + len(image) - 2
            logits.append(trainee.lisa.lm_head(row[first : first + len(answer)]))
            targets.append(torch.tensor(answer))
    wanted = concept_tokens[[question.concept for question in batch.questions]]
    seen = trainee.see(torch.stack(images)).log_softmax(-1)
    terms = {
        "token": functional.mse_loss(torch.stack(said), wanted),
        "clip": -(batch.shares.flatten(2).transpose(1, 2) * seen).sum(-1).mean(),
    }
    if logits:
        terms["answer"] = functional.cross_entropy(torch.cat(logits), torch.cat(targets))
    return terms
