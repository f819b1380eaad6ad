"""The stages in which the compact LISA is trained. Trained in one piece from scratch, its masks stay empty.

1. ``encoder``: SAM's image encoder with a dense class head, cross-entropy and dice;
2. ``decoder``: SAM's mask decoder from a fixed token per concept, the encoder moving along more slowly;
3. ``language``: CLIP, projector and Llama learn to answer, and to give the concept's token at [SEG].

The tokens are fixed from the start, so the third stage needs nothing of the others and can run beside them. Each stage
goes on from its own checkpoint where it has one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from cable_models.lisa.model import LisaModel
from cable_models.lisa.special_tokens import SpecialTokens
from cable_models.lisa.tokenizer import SEG_TEXT, LisaTokenizer
from cable_models.training.segmentation_batches import BatchMaker
from cable_models.training.segmentation_evaluation import Segment, dense_segmenter, token_segmenter
from cable_models.training.segmentation_language import (
    CompactLisaConfig,
    LanguageTrainee,
    language_batch,
    language_loss,
)
from cable_models.training.segmentation_losses import dense_loss, mask_loss
from cable_models.training.segmentation_state import averaged
from cable_models.training.segmentation_tokenizer import write_tokenizer
from cable_models.training.segmentation_trainer import LossTerms, StageConfig, StageProgress, train_stage
from cable_models.training.segmentation_views import ViewConfig
from cable_models.training.segmentation_vision import CONCEPTS, VisionTrainee, concept_shares, concept_tokens
from cable_models.training.upload_views import CONSTANT_FILLS, WeightedFill

Stage = Literal["encoder", "decoder", "language"]
STAGES: tuple[Stage, ...] = get_args(Stage)

TIME_SHARES: Mapping[Stage, float] = {"encoder": 0.55, "decoder": 0.35, "language": 0.1}
"""How a whole training divides its time."""

LANGUAGE_PACE = 2.5
"""Rates of the language stage, as a multiple of those of the others."""

TOKEN_NOISE = 0.15
"""Standard deviation of what is added to concept tokens (unit variance) while the decoder learns them."""

CONCEPTS_AT_ONCE = 2

Report = Callable[[StageProgress, Segment | None], None]
"""Told where a stage stands, and given the averaged model as a segmenter where the stage makes masks."""


@dataclass(frozen=True, slots=True)
class SegmenterTraining:
    """A training in a folder: samples in ``train`` and ``held_out``, one checkpoint per stage."""

    work: Path
    network: CompactLisaConfig = field(default_factory=CompactLisaConfig)
    batch: int = 8
    views: ViewConfig = field(default_factory=ViewConfig)
    fills: Sequence[WeightedFill] = CONSTANT_FILLS
    """What may stand outside the region in masked images."""
    seed: int = 0

    def checkpoint(self, stage: Stage) -> Path:
        """Where a stage keeps what it needs to go on."""
        return self.work / f"{stage}.pt"

    @property
    def tokenizer_folder(self) -> Path:
        """Where the tokenizer's files lie."""
        return self.work / "tokenizer"

    def tokenizer(self) -> tuple[LisaTokenizer, SpecialTokens]:
        """The tokenizer, trained on first use."""
        folder = self.tokenizer_folder
        if not (folder / "added_tokens.json").is_file():
            folder.mkdir(parents=True, exist_ok=True)
            write_tokenizer(folder)
        tokenizer = LisaTokenizer.from_folder(folder)
        return tokenizer, SpecialTokens(seg=tokenizer.token_id(SEG_TEXT))

    def batches(self) -> BatchMaker:
        """Batches of this network's size."""
        sam = self.network.sam
        return BatchMaker(self.work / "train", sam.image_size, sam.patch_size, self.batch, self.views, self.fills)

    def fresh_vision(self) -> VisionTrainee:
        """SAM before any training."""
        torch.manual_seed(self.seed)
        return VisionTrainee(self.network.sam)

    def fresh_language(self) -> LanguageTrainee:
        """LISA before any training."""
        torch.manual_seed(self.seed + 1)
        return LanguageTrainee(self.network, *self.tokenizer())

    def assembled(self) -> LisaModel:
        """The whole model with the averaged weights of the stages.

        Raises:
            ModelError: a stage has no checkpoint.
        """
        vision, language = self.fresh_vision(), self.fresh_language()
        vision.load_state_dict(averaged(self.checkpoint("decoder")))
        language.load_state_dict(averaged(self.checkpoint("language")))
        language.lisa.sam.load_state_dict(vision.sam.state_dict())
        return language.lisa.eval().requires_grad_(False)


def run_stage(
    training: SegmenterTraining,
    stage: Stage,
    config: StageConfig,
    report: Report,
    should_stop: Callable[[], bool] = lambda: False,
) -> bool:
    """Trains one stage to the end of its time.

    Args:
        training: Folder and sizes.
        stage: Which one.
        config: Schedule.
        report: Listener.
        should_stop: Asked before every step.

    Returns:
        Whether the stage has come to its end; False where it was stopped.

    Raises:
        ModelError: no samples, a stage before it that was never run, or a checkpoint of another network.
    """
    runners = {"encoder": train_encoder, "decoder": train_decoder, "language": train_language}
    return runners[stage](training, config, report, should_stop)


def train_encoder(
    training: SegmenterTraining, config: StageConfig, report: Report, should_stop: Callable[[], bool]
) -> bool:
    """Stage 1, see `run_stage`."""
    trainee, probe, batches = training.fresh_vision(), training.fresh_vision(), training.batches()

    def loss(rng: np.random.Generator) -> LossTerms:
        batch = batches.next(rng)
        return {"dense": dense_loss(trainee.dense_head(trainee.features(batch.pixels)), batch.shares)}

    def told(progress: StageProgress, average: Mapping[str, Tensor]) -> None:
        probe.load_state_dict(average)
        report(progress, dense_segmenter(probe))

    return train_stage(trainee, loss, config, training.checkpoint("encoder"), told, should_stop=should_stop)


def train_decoder(
    training: SegmenterTraining, config: StageConfig, report: Report, should_stop: Callable[[], bool]
) -> bool:
    """Stage 2, see `run_stage`; the dense head keeps teaching the encoder."""
    trainee, probe, batches = training.fresh_vision(), training.fresh_vision(), training.batches()
    trainee.load_state_dict(averaged(training.checkpoint("encoder")))

    def loss(rng: np.random.Generator) -> LossTerms:
        batch = batches.next(rng)
        features = trainee.features(batch.pixels)
        # All concepts at once would double the time of a step.
        asked = rng.choice(len(CONCEPTS), CONCEPTS_AT_ONCE, replace=False).tolist()
        tokens = trainee.concept_tokens[asked]
        noisy = tokens + TOKEN_NOISE * torch.randn(len(features), *tokens.shape)
        masks = trainee.masks(features, noisy)
        wanted = concept_shares(batch.shares)[:, asked]
        return {
            "dense": 0.5 * dense_loss(trainee.dense_head(features), batch.shares),
            "mask": mask_loss(masks, wanted, batch.shares.sum(1, keepdim=True)),
        }

    def told(progress: StageProgress, average: Mapping[str, Tensor]) -> None:
        probe.load_state_dict(average)
        report(progress, token_segmenter(probe))

    slow = (trainee.sam.vision_encoder,)
    return train_stage(trainee, loss, config, training.checkpoint("decoder"), told, slow=slow, should_stop=should_stop)


def train_language(
    training: SegmenterTraining, config: StageConfig, report: Report, should_stop: Callable[[], bool]
) -> bool:
    """Stage 3, see `run_stage`."""
    trainee, batches, network = training.fresh_language(), training.batches(), training.network
    wanted = concept_tokens(network.sam.channels)

    def loss(rng: np.random.Generator) -> LossTerms:
        batch = language_batch(batches.samples(rng), network.clip_image, network.clip_patch, rng)
        return language_loss(trainee, batch, wanted)

    def told(progress: StageProgress, average: Mapping[str, Tensor]) -> None:
        report(progress, None)

    quick = replace(
        config,
        learning_rate=LANGUAGE_PACE * config.learning_rate,
        matrix_rate=LANGUAGE_PACE * config.matrix_rate,
    )
    return train_stage(trainee, loss, quick, training.checkpoint("language"), told, should_stop=should_stop)
