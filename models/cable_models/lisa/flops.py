"""Floating-point operations of one frame, stage by stage, counted on the very functions that the pipeline runs.

The model stands on the meta device, where tensors have shapes and no content: nothing is computed and nothing is
allocated, so the published sizes are counted in seconds on any machine. Operations are those of
`torch.utils.flop_counter`: two for each multiply-add of a matrix product or convolution, attention in full (causal
kernels skip half of it), nothing for norms, activations, softmax and resizing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import DynamicCache

from cable_models.lisa.architecture import ClipPreprocessing, LisaArchitecture, square_side
from cable_models.lisa.clip_tower import patch_features, project
from cable_models.lisa.decoding import ForcedPrompt, force, next_state
from cable_models.lisa.frame_input import BoolMask, FrameInput, prepare_frame
from cable_models.lisa.images import Size
from cable_models.lisa.language import ImageTokens, forward, segmentation_embeddings, splice
from cable_models.lisa.loader import build_empty
from cable_models.lisa.mask_decoder import decode_masks, dense_positional_embedding
from cable_models.lisa.model import LisaModel
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.original import Question, original_frame
from cable_models.lisa.sam_encoder import encode, grid_of
from cable_models.lisa.stage_timer import StageTimer


@dataclass(frozen=True, slots=True)
class FrameFlops:
    """Operations of one frame."""

    clip: int
    projector: int
    prefill: int
    """First pass of the language model."""
    decode: int
    """Its passes for the tokens that follow."""
    lm_head: int
    sam_encoder: int
    mask_decoder: int
    """With the layers that make its prompt of a hidden state."""

    @property
    def total(self) -> int:
        """All stages."""
        return sum(getattr(self, field.name) for field in fields(self))


class StageCounter:
    """Collects the operations of named stages; a stage entered twice is added up."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys((field.name for field in fields(FrameFlops)), 0)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts what runs inside."""
        with FlopCounterMode(display=False) as counter:
            yield
        self._counts[name] += counter.get_total_flops()

    def frame(self) -> FrameFlops:
        """All stages so far."""
        return FrameFlops(**self._counts)


def meta_lisa(architecture: LisaArchitecture) -> LisaModel:
    """A model of shapes alone, to count with.

    The language model's mask is made without a look at its values, which a tensor without content doesn't have. SAM's
    positional encoding is made once for as long as a model lives, so that no frame is charged for it.
    """
    model = build_empty(architecture).eval()
    model.language_model.set_attn_implementation("eager")
    dense_positional_embedding(model.sam)
    return model


def count_original(model: LisaModel, frame: FrameInput, question: Question) -> FrameFlops:
    """The published inference, of which the region spares nothing; see `original.original_frame`."""
    counter = StageCounter()
    original_frame(model, clip_pixels(model, frame), sam_pixels(model, frame), question, counter)
    return counter.frame()


@torch.inference_mode()
def count_generated(
    model: LisaModel, frame: FrameInput, question: Question, *, clip_patches: bool = False, compact: bool = False
) -> FrameFlops:
    """Greedy decoding with a cache, as `decoding.generate` does it when the model says the given answer.

    Args:
        model: Of `meta_lisa`.
        frame: Its content doesn't matter, its kept patches and its plan for SAM do.
        question: Prompt and answer.
        clip_patches: Patches outside the region are dropped before CLIP already.
        compact: See `language.splice`.
    """
    counter = StageCounter()
    image = count_image_tokens(counter, model, frame, clip_patches)
    cache = DynamicCache(config=model.language_model.config)
    with counter.stage("prefill"):
        prompt = splice(model, question.ids, image, question.tokens.image_placeholder, compact=compact)
        state = forward(model, prompt.embeddings[None], prompt.positions[None], cache)[0, -1]
    for spoken in range(len(question.answer)):
        with counter.stage("decode"):
            state = next_state(model, prompt, question.answer[:spoken], cache) if spoken else state
        with counter.stage("lm_head"):
            model.lm_head(state)
    count_masks(counter, model, frame, state.expand(question.masks, -1))
    return counter.frame()


@torch.inference_mode()
def count_forced(
    model: LisaModel,
    frame: FrameInput,
    question: Question,
    *,
    clip_patches: bool = False,
    compact: bool = False,
    bucket: int = 0,
) -> FrameFlops:
    """One pass over the prompt and what of the answer stands before its last [SEG]; arguments of `count_generated`."""
    counter = StageCounter()
    image = count_image_tokens(counter, model, frame, clip_patches)
    prompt = ForcedPrompt(question.ids, question.answer, image, verify=False)
    with counter.stage("prefill"):
        answers = force(
            model, question.tokens, [prompt], compact=compact, timer=StageTimer(model.device), bucket=bucket
        )
    count_masks(counter, model, frame, answers[0].states)
    return counter.frame()


def blank_frame(
    model: LisaModel, frame_hw: Size, roi: BoolMask | None = None, options: LisaOptions | None = None
) -> FrameInput:
    """A frame without a picture, to count with: its size and its region decide what is computed.

    Args:
        model: The network.
        frame_hw: (H, W).
        roi: bool [H, W]; None = the whole frame.
        options: Switches; those that change how frames are prepared matter.
    """
    clip = model.architecture.clip
    return prepare_frame(
        np.zeros((*frame_hw, 3), np.uint8),
        roi,
        ClipPreprocessing(square_side(clip.image_size)),
        square_side(clip.patch_size),
        grid_of(model.sam.vision_encoder),
        options or LisaOptions(),
    )


def count_image_tokens(counter: StageCounter, model: LisaModel, frame: FrameInput, clip_patches: bool) -> ImageTokens:
    """The visual tokens of a frame, as the pipeline makes them."""
    numbers = None if frame.kept_patches is None else torch.from_numpy(frame.kept_patches).to(model.device)
    with counter.stage("clip"):
        features = patch_features(model, clip_pixels(model, frame), [numbers] if clip_patches else None)[0]
        if numbers is not None and not clip_patches:
            features = features[numbers]
    with counter.stage("projector"):
        tokens = project(model, [features])[0]
    return ImageTokens(tokens, numbers, model.architecture.image_tokens)


def count_masks(counter: StageCounter, model: LisaModel, frame: FrameInput, states: torch.Tensor) -> None:
    """SAM's share: ``states`` [n_seg, width] stand before the [SEG] tokens."""
    with counter.stage("sam_encoder"):
        features = encode(model.sam.vision_encoder, sam_pixels(model, frame), [frame.sam_plan])
    with counter.stage("mask_decoder"):
        decode_masks(model.sam, features, [segmentation_embeddings(model, states)])


def clip_pixels(model: LisaModel, frame: FrameInput) -> torch.Tensor:
    """CLIP's input of one frame, [1, 3, S, S]."""
    return torch.as_tensor(frame.clip_pixels)[None].to(model.device, model.dtype)


def sam_pixels(model: LisaModel, frame: FrameInput) -> torch.Tensor:
    """SAM's input of one frame, [1, 3, S, S]."""
    return torch.as_tensor(frame.sam_pixels)[None].to(model.device, model.dtype)
