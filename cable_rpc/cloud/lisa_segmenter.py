"""LISA++ as a segmenter: the union of its [SEG] masks, and what its language model cost.

torch and transformers are loaded with the model, not with this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from cable_models.embedded import embedded_segmenter_path
from cable_models.errors import ModelError as LisaError

from cable_rpc.cloud.backends import BackendOptions, FrameContext, SegmentationRequest
from cable_rpc.cloud.mask_confidence import mask_confidence, uncertainty_of, united_logits
from cable_rpc.cloud.perception import DEFAULT_PROMPT
from cable_rpc.cloud.spec_options import options_text, read_options
from cable_rpc.cloud.weights_revision import weights_revision
from cable_rpc.errors import ConfigurationError, ModelError
from cable_rpc.types import BoolMask, Detections, Image, PrefillCost, Segmentation

WARM_UP_STREAM = "warm-up"
MAX_PROMPT_CHARACTERS = 2000
"""Longest question taken from a client: the memory that a prompt takes grows with its length."""

if TYPE_CHECKING:
    import torch
    from cable_models.lisa.loader import LoadedLisa
    from cable_models.lisa.pipeline import FrameAnswer, LisaPipeline


@dataclass(frozen=True, slots=True)
class LisaSource:
    """Which weights, and how they are held."""

    clip: str = field(
        default="", metadata={"help": "CLIP tower, a folder or a hub's id, where not the one that the checkpoint names"}
    )
    revision: str = field(default="", metadata={"help": "branch, tag or commit of a hub's id"})
    dtype: Literal["auto", "bf16", "fp16", "fp32"] = field(
        default="auto", metadata={"help": "number format of the weights; auto: bf16 on a GPU, fp32 on a CPU"}
    )
    decoder_dtype: Literal["same", "bf16", "fp16", "fp32"] = field(
        default="same", metadata={"help": "number format of SAM's mask decoder; fp32 costs next to nothing"}
    )


class LisaSegmenter:
    """Runs a `LisaPipeline`; forced answers are checked for each stream.

    Args:
        pipeline: the loaded model with its switches.
        name: what the clients are told.
        revision: which weights.
    """

    uses_detections = False

    def __init__(self, pipeline: LisaPipeline, *, name: str, revision: str) -> None:
        self._pipeline = pipeline
        self.name = name
        self.revision = revision
        self.device = str(pipeline.loaded.model.device)

    def segment(self, image: Image, roi: BoolMask, prompt: str, context: FrameContext) -> Segmentation:
        """See `Segmenter`; a prompt is a question such as "Can you segment the cars in this image?".

        Raises:
            ModelError: the prompt is too long, the model can't answer it, or its logits are not numbers.
        """
        return self.segment_batch([SegmentationRequest(image, roi, prompt, context)])[0]

    def segment_batch(self, requests: Sequence[SegmentationRequest]) -> list[Segmentation]:
        """See `BatchSegmenter`.

        Raises:
            ModelError: as `segment`; one bad request fails them all.
        """
        from cable_models.lisa.pipeline import FrameRequest

        longest = max(len(request.prompt) for request in requests)
        if longest > MAX_PROMPT_CHARACTERS:
            raise ModelError(
                f"{self.name}: the prompt has {longest} characters, at most {MAX_PROMPT_CHARACTERS} are taken"
            )
        frames = [
            FrameRequest(request.image, request.roi, request.prompt, request.context.stream) for request in requests
        ]
        try:
            answers = self._pipeline.segment(frames)
        except LisaError as error:
            raise ModelError(f"{self.name}: {error}") from error
        return [segmentation_of(answer, request.roi) for answer, request in zip(answers, requests, strict=True)]

    def forget_stream(self, stream: str) -> None:
        """Drops what is remembered of a session's answers."""
        self._pipeline.forget_stream(stream)


def segmentation_of(answer: FrameAnswer, roi: BoolMask) -> Segmentation:
    """One frame's answer as a `Segmentation`: an answer without [SEG] is an empty mask of confidence 1.

    Args:
        answer: of the pipeline.
        roi: bool [height, width]; confidence is judged inside only.

    Raises:
        ModelError: a logit is not a number.
    """
    prefill = answer.prefill
    mask, confidence, uncertainty = np.zeros_like(roi), 1.0, np.zeros(roi.shape, np.uint8)
    if len(answer.mask_logits):
        logits = united_logits(answer.mask_logits)
        if np.isnan(logits.max()):
            raise ModelError("LISA's mask logits are not numbers: its number format overflows; use dtype=bf16 or fp32")
        mask, confidence, uncertainty = logits > 0, mask_confidence(logits, roi), uncertainty_of(logits)
    return Segmentation(
        mask,
        confidence,
        prefill.image_tokens,
        prefill.whole_image_tokens,
        uncertainty,
        PrefillCost(
            prefill.prompt_tokens,
            prefill.speedup_quadratic,
            prefill.speedup_flops,
            prefill.measured_ns,
            prefill.whole_ns,
        ),
        dict(answer.stage_ns),
        answer.text,
        decoding_of(answer),
    )


def decoding_of(answer: FrameAnswer) -> str:
    """How an answer came about: ``forced``, ``forced, checked``, ``generate``, or ``generate, forced refused``."""
    if answer.forced:
        return "forced, checked" if answer.agrees else "forced"
    return "generate, forced refused" if answer.agrees is False else "generate"


def load_lisa(argument: str, options: BackendOptions) -> LisaSegmenter:
    """Entry point ``lisa:FOLDER_OR_HUB_ID?key=value&...``; the keys are the fields of `LisaSource` and `LisaOptions`.

    Raises:
        ConfigurationError: no checkpoint is named, an option or the device can't be used, or torch is missing.
        ModelError: the checkpoint can't be loaded, or brings no tokenizer.
    """
    try:
        import torch
        from cable_models.lisa.loader import load_lisa as load_checkpoint
        from cable_models.lisa.options import LisaOptions
        from cable_models.lisa.pipeline import LisaPipeline
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"the lisa segmenter needs {error.name}: pip install 'cable-rpc[cloud]'") from error
    checkpoint, _, query = argument.partition("?")
    if not checkpoint:
        raise ConfigurationError(
            "lisa needs a checkpoint, a folder or a hub's id: --segmenter lisa:Senqiao/LISA_Plus_7b; options may "
            f"follow as ?key=value&key=value:\n{options_text(LisaSource, LisaOptions)}"
        )
    spec = f"lisa:{argument}"
    source_settings, settings = read_options(spec, query, LisaSource, LisaOptions)
    source = LisaSource(**source_settings)
    device = torch_device(options.device)
    formats = number_formats(device)
    if device == "cpu":
        torch.set_num_threads(options.threads)
    try:
        switches = LisaOptions(**settings)
    except LisaError as error:
        raise ConfigurationError(f"'{spec}': {error}") from error
    try:
        loaded = load_checkpoint(
            checkpoint,
            clip=source.clip or None,
            revision=source.revision or None,
            device=device,
            dtype=formats[source.dtype],
            decoder_dtype=formats.get(source.decoder_dtype),
        )
        require_tokenizer(loaded, checkpoint)
        pipeline = LisaPipeline(loaded, switches)
    except LisaError as error:
        raise ModelError(str(error)) from error
    except torch.OutOfMemoryError as error:
        raise ModelError(
            f"{checkpoint} does not fit into the memory of {device}; "
            "the weights alone of a 7B checkpoint take 15.5 GB in bf16"
        ) from error
    name = loaded.folder.resolve().name if Path(checkpoint).expanduser().is_dir() else checkpoint
    segmenter = LisaSegmenter(pipeline, name=f"lisa:{name}", revision=weights_revision(loaded.folder))
    if device == "cuda":
        warm_up(segmenter)
    return segmenter


def warm_up(segmenter: LisaSegmenter) -> None:
    """Runs grey frames, whole and in part, so that no camera pays for a GPU's first kernels.

    Three whole ones: the first is slow, and the median that prefills are compared with must not be.
    """
    height, width = 720, 1280
    whole = np.ones((height, width), np.bool_)
    part = whole.copy()
    part[: height // 4] = False
    image = np.full((height, width, 3), 128, np.uint8)
    for roi in (whole, whole, whole, part):
        segmenter.segment(image, roi, DEFAULT_PROMPT, FrameContext(0, Detections.empty(), WARM_UP_STREAM))
    segmenter.forget_stream(WARM_UP_STREAM)


def load_embedded(argument: str, options: BackendOptions) -> LisaSegmenter:
    """Entry point ``embedded[?key=value&...]``: the compact LISA trained on the rendered world.

    Raises:
        ConfigurationError: an option can't be used, or torch is missing.
        ModelError: it is not part of this installation.
    """
    if argument and not argument.startswith("?"):
        raise ConfigurationError(f"the embedded segmenter takes options only, as embedded?key=value, got '{argument}'")
    try:
        folder = embedded_segmenter_path()
    except LisaError as error:
        raise ModelError(str(error)) from error
    return load_lisa(f"{folder}{argument}", options)


def torch_device(wanted: str) -> str:
    """The device's name for torch; ``auto`` takes a GPU where there is one.

    Raises:
        ConfigurationError: unknown name, or a GPU that torch does not see.
    """
    import torch

    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ConfigurationError(
            f"torch {torch.__version__} sees no GPU: use --device cpu, or install a torch build for your driver"
        )
    if wanted not in ("cpu", "cuda"):
        raise ConfigurationError(f"device '{wanted}' is unknown; use auto, cpu or cuda")
    return wanted


def number_formats(device: str) -> dict[str, torch.dtype]:
    """Formats of the weights by the names that users give; ``auto`` is what the device is fast in."""
    import torch

    formats = {"bf16": torch.bfloat16, "fp16": torch.float16, "fp32": torch.float32}
    return formats | {"auto": torch.float32 if device == "cpu" else torch.bfloat16}


def require_tokenizer(loaded: LoadedLisa, checkpoint: str) -> None:
    """Refuses a checkpoint that can't read a question.

    Raises:
        ModelError: it has no tokenizer.
    """
    if loaded.tokenizer is None:
        raise ModelError(
            f"{checkpoint}: this checkpoint has no tokenizer.model, so it can't read a prompt; put the tokenizer.model "
            "it was trained with (Vicuna's sentencepiece model) and its added_tokens.json beside its config.json"
        )
