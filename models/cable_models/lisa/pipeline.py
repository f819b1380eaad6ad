"""LISA++ from camera frames to masks: several frames at once, each computed only where its region asks for it."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
import numpy.typing as npt
import torch

from cable_models.detection import Float32Array, Image
from cable_models.lisa.clip_tower import patch_features, project
from cable_models.lisa.compiled import compile_model
from cable_models.lisa.decoding import Answer
from cable_models.lisa.frame_input import BoolMask, FrameInput, prepare_frame
from cable_models.lisa.language import ImageTokens, segmentation_embeddings
from cable_models.lisa.loader import LoadedLisa
from cable_models.lisa.mask_decoder import decode_masks, upsample_logits
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.prefill_cost import PrefillCost, prefill_cost
from cable_models.lisa.prompt_ids import first_forced_answer, prompt_ids
from cable_models.lisa.sam_encoder import encode, grid_of
from cable_models.lisa.stage_timer import StageTimer
from cable_models.lisa.stream_answers import StreamAnswers

WHOLE_PREFILLS_KEPT = 9


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """One frame to segment."""

    image: Image
    """uint8 [H, W, 3] BGR."""
    roi: BoolMask | None
    """bool [H, W], R_k; None = the whole frame."""
    prompt: str | Sequence[int]
    """The question, or the ids of a whole prompt with the image placeholder."""
    stream: str = ""
    """Camera stream that the frame belongs to; each has its own forced answer."""


@dataclass(frozen=True, slots=True)
class FrameAnswer:
    """What LISA++ says of one frame."""

    mask_logits: Float32Array
    """float32 [n_seg, H, W], in the order of the answer's [SEG] tokens; far below 0 where nothing was computed."""
    answer_ids: tuple[int, ...]
    text: str
    """The answer in words; "" where the checkpoint has no tokenizer."""
    forced: bool
    """Whether the answer was forced; generated otherwise."""
    agrees: bool | None
    """Whether greedy decoding says what was to be forced; None = not checked on this frame."""
    prefill: PrefillCost
    stage_ns: Mapping[str, int]
    """Durations of preprocess, clip, prefill, decode, sam_encoder, mask_decoder and postprocess; of the whole batch."""
    batch_size: int

    @property
    def masks(self) -> npt.NDArray[np.bool_]:
        """bool [n_seg, H, W]."""
        return self.mask_logits > 0


class LisaPipeline:
    """A loaded model with its switches, and what it remembers of the streams it serves."""

    def __init__(self, loaded: LoadedLisa, options: LisaOptions | None = None) -> None:
        self.loaded = loaded
        self.options = options or LisaOptions()
        if self.options.compile != "none":
            compile_model(loaded.model, self.options.compile)
        answer = first_forced_answer(loaded, self.options)
        self._patch_size = loaded.clip_preprocessing.size // loaded.architecture.patch_grid
        self._grid = grid_of(loaded.model.sam.vision_encoder)
        self._answers = StreamAnswers(loaded.model, loaded.tokens, self.options, answer)
        self._whole_prefills_ns: dict[int, deque[int]] = defaultdict(lambda: deque(maxlen=WHOLE_PREFILLS_KEPT))

    def forget_stream(self, stream: str) -> None:
        """Drops what is remembered of a stream that has ended."""
        self._answers.forget(stream)

    @torch.inference_mode()
    def segment(self, requests: Sequence[FrameRequest]) -> list[FrameAnswer]:
        """Masks of several frames in one batch; frames may differ in size, region, prompt and stream.

        Raises:
            ModelError: an image or a region of the wrong kind, or a text prompt without a tokenizer.
        """
        if not requests:
            return []
        model = self.loaded.model
        timer = StageTimer(model.device)
        with timer.stage("preprocess"):
            prompts = [prompt_ids(self.loaded, request.prompt, self.options) for request in requests]
            frames = [
                prepare_frame(
                    request.image,
                    request.roi,
                    self.loaded.clip_preprocessing,
                    self._patch_size,
                    self._grid,
                    self.options,
                    model.device,
                )
                for request in requests
            ]
            clip_pixels = torch.stack([frame.clip_pixels for frame in frames])
            sam_pixels = torch.stack([frame.sam_pixels for frame in frames])
        with timer.stage("clip"):
            images = self._image_tokens(clip_pixels, frames)
        answers = self._answers.answer([request.stream for request in requests], prompts, images, timer)
        with timer.stage("sam_encoder"):
            pixels = sam_pixels.to(model.dtype)
            features = encode(
                model.sam.vision_encoder,
                pixels,
                [frame.sam_plan for frame in frames],
                run_whole=model.stacks.sam,
                run_block=model.stacks.sam_tokens,
            )
        with timer.stage("mask_decoder"):
            sparse = [segmentation_embeddings(model, answer.states) for answer in answers]
            low_resolution = decode_masks(model.sam, features, sparse)
        with timer.stage("postprocess"):
            logits = [
                upsample_logits(masks, frame.sam_hw, frame.frame_hw, self._grid.image_size).cpu().numpy()
                for masks, frame in zip(low_resolution, frames, strict=True)
            ]
        return self._collected(prompts, images, answers, logits, timer.durations_ns())

    def _image_tokens(self, pixels: torch.Tensor, frames: Sequence[FrameInput]) -> list[ImageTokens]:
        """The visual tokens of each frame that enter the language model."""
        model = self.loaded.model
        kept = [
            None if frame.kept_patches is None else torch.from_numpy(frame.kept_patches).to(model.device)
            for frame in frames
        ]
        if self.options.clip_patches == "drop":
            features = patch_features(model, pixels, kept)
        else:
            whole = patch_features(model, pixels)
            features = [row if numbers is None else row[numbers] for row, numbers in zip(whole, kept, strict=True)]
        count = model.architecture.image_tokens
        tokens = project(model, features)
        return [ImageTokens(row, numbers, count) for row, numbers in zip(tokens, kept, strict=True)]

    def _collected(
        self,
        prompts: Sequence[tuple[int, ...]],
        images: Sequence[ImageTokens],
        answers: Sequence[Answer],
        logits: Sequence[Float32Array],
        stages_ns: Mapping[str, int],
    ) -> list[FrameAnswer]:
        costs = self._prefill_costs(prompts, images, answers, stages_ns["prefill"] // len(prompts))
        tokenizer = self.loaded.tokenizer
        return [
            FrameAnswer(
                mask_logits,
                answer.ids,
                "" if tokenizer is None else tokenizer.decode(answer.ids),
                answer.forced,
                answer.agrees,
                cost,
                stages_ns,
                len(answers),
            )
            for mask_logits, answer, cost in zip(logits, answers, costs, strict=True)
        ]

    def _prefill_costs(
        self,
        prompts: Sequence[tuple[int, ...]],
        images: Sequence[ImageTokens],
        answers: Sequence[Answer],
        measured_ns: int,
    ) -> list[PrefillCost]:
        alone = len(prompts) == 1 and answers[0].agrees is not False
        if alone and images[0].numbers is None:
            self._whole_prefills_ns[len(prompts[0])].append(measured_ns)
        llama = self.loaded.model.architecture.llama
        costs = []
        for ids, image in zip(prompts, images, strict=True):
            known = self._whole_prefills_ns.get(len(ids))
            whole_ns = int(median(known)) if known else 0
            kept = len(image.features)
            costs.append(prefill_cost(llama, len(ids) - 1, kept, image.whole, measured_ns, whole_ns))
        return costs
