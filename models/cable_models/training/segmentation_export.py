"""From stages to a checkpoint in LISA++'s layout, and its figures through the pipeline that serves it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from cable_models.detection import Image
from cable_models.lisa.loader import load_lisa
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.pipeline import FrameRequest, LisaPipeline
from cable_models.lisa.saver import save_lisa
from cable_models.training.segmentation_evaluation import BoolMask, Segment
from cable_models.training.segmentation_stages import SegmenterTraining

CONCEPT_PROMPTS = (
    "Please segment all vehicles, pedestrians and cyclists on the road.",
    "Can you segment the vehicles in this image?",
    "Can you segment the pedestrians in this image?",
    "Can you segment the cyclists in this image?",
)
"""One question for each of `CONCEPTS`."""


def export_segmenter(training: SegmenterTraining, folder: Path, dtype: torch.dtype = torch.float16) -> Path:
    """Writes the trained model under LISA's original names; ``folder`` must be new or empty.

    Raises:
        ModelError: a stage has no checkpoint, or the folder can't be written.
    """
    model = training.assembled()
    _, tokens = training.tokenizer()
    return save_lisa(model, model.architecture, folder, tokens, tokenizer_folder=training.tokenizer_folder, dtype=dtype)


def pipeline_segmenter(folder: Path, options: LisaOptions | None = None) -> Segment:
    """The exported model as it is served, one question per concept."""
    pipeline = LisaPipeline(load_lisa(folder, dtype=torch.float32), options)

    def segment(image: Image, region: BoolMask | None) -> BoolMask:
        answers = pipeline.segment([FrameRequest(image, region, prompt) for prompt in CONCEPT_PROMPTS])
        masks = np.stack([answer.masks.any(axis=0) for answer in answers])
        return masks if region is None else masks & region

    return segment
