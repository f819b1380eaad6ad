"""What the models find in a clip's frames whole and before any coding: what every cell of the clip is held against."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from cable_rpc.cloud.perception import PerceptionRequest
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.closed_loop.measured_frame import Reference
from cable_rpc.study.closed_loop.models import LoadedModels, ModelLoader, load_models
from cable_rpc.study.digests import weights_digest
from cable_rpc.study.sequence_metrics import OPERATING_SCORE
from cable_rpc.study.sweep.cell import ClipRequest, TruthChoice
from cable_rpc.study.sweep.clip_store import StoredClip, stored_clip
from cable_rpc.study.sweep.identity import measuring_code
from cable_rpc.types import COCO_ROAD_USERS, BoolMask, Detections, Frame, GroundTruth


@dataclass(frozen=True, slots=True)
class PreparedClip:
    """Frames, and what the models find in each of them before any coding."""

    clip: StoredClip
    references: tuple[Reference, ...]
    truth: Literal["annotated", "detector"]

    def __iter__(self) -> Iterator[tuple[Frame, Reference]]:
        """Frames with the objects that they are judged by, and the models' results on them."""
        for frame, reference in zip(self.clip, self.references, strict=True):
            if self.truth == "detector":
                frame = replace(frame, truth=pseudo_truth(reference.detections))
            yield frame, reference


def prepare_clip(request: ClipRequest, cache: Path, load: ModelLoader = load_models) -> None:
    """Decode a clip and run the models on its frames, where that has not been done yet.

    Args:
        request: which frames, which models.
        cache: the folder of all clips; processes beside each other may share it.
        load: what loads the models.

    Raises:
        ConfigurationError: the source or a model can't be opened so, or the folder can't be written to.
        SourceError: the source can't be read, or has no frames.
        ModelError: a model can't be loaded, or failed.
    """
    clip = stored_clip(request, cache)
    path = clip.folder / f"{reference_key(request)}.npz"
    if not path.is_file():
        found = asyncio.run(whole_frame_results(clip, load(request.models), request.prompt))
        write_references(found, path)


def prepared_clip(request: ClipRequest, cache: Path, load: ModelLoader = load_models) -> PreparedClip:
    """A clip with its reference, prepared now where it isn't yet.

    Raises:
        As `prepare_clip`; and ConfigurationError where annotated objects are asked for and there are none.
    """
    prepare_clip(request, cache, load)
    clip = stored_clip(request, cache)
    references = read_references(clip.folder / f"{reference_key(request)}.npz", clip.size_wh)
    return PreparedClip(clip, references, judged_by(request.truth, clip))


def judged_by(choice: TruthChoice, clip: StoredClip) -> Literal["annotated", "detector"]:
    """Which objects count.

    Raises:
        ConfigurationError: annotated ones are asked for, and there are none.
    """
    if choice == "annotated" and not clip.annotated:
        raise ConfigurationError(f"'{clip.name}' has no annotated frames; use truth: auto or detector")
    return "annotated" if clip.annotated and choice != "detector" else "detector"


def pseudo_truth(found: Detections) -> GroundTruth:
    """A detector's sure finds of road users as the objects to be found.

    Fischer et al., "Evaluation of Video Coding for Machines without Ground Truth" (ICASSP 2022).
    """
    sure = (found.scores >= OPERATING_SCORE) & np.isin(found.class_ids, list(COCO_ROAD_USERS))
    kept = found.select(sure)
    rows = np.arange(len(kept), dtype=np.int32)
    return GroundTruth(kept.boxes_xyxy, kept.class_ids, rows, np.ones(len(kept), np.float32))


def reference_key(request: ClipRequest) -> str:
    """A file name for what some models, as they are now, find."""
    models = request.models
    identity = [
        asdict(models),
        request.prompt,
        weights_digest(models.detector, detector=True),
        weights_digest(models.segmenter, detector=False),
        measuring_code(),
    ]
    return "reference-" + hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:16]


async def whole_frame_results(clip: StoredClip, models: LoadedModels, prompt: str) -> list[Reference]:
    """Both models on every frame."""
    found = []
    for frame in clip:
        answer = await models.perception.perceive(
            PerceptionRequest(frame.image, None, OPERATING_SCORE, prompt, frame.index), "reference"
        )
        found.append(Reference(models.keeper.newest, answer.segmentation.mask))
    models.perception.forget_stream("reference")
    return found


def write_references(found: list[Reference], path: Path) -> None:
    """All frames' results into one file, which is there whole or not at all.

    Raises:
        ConfigurationError: it can't be written.
    """
    try:
        handle, part = tempfile.mkstemp(prefix="part-", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            np.savez(
                file,
                counts=np.array([len(one.detections) for one in found], np.int64),
                boxes=np.concatenate([one.detections.boxes_xyxy for one in found]),
                class_ids=np.concatenate([one.detections.class_ids for one in found]),
                scores=np.concatenate([one.detections.scores for one in found]),
                masks=np.stack([np.packbits(one.mask) for one in found]),
            )
        os.replace(part, path)
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror or error}; free space there") from error


def read_references(path: Path, size_wh: tuple[int, int]) -> tuple[Reference, ...]:
    """The inverse of `write_references`."""
    width, height = size_wh
    with np.load(path, allow_pickle=False) as stored:
        ends = np.cumsum(stored["counts"])[:-1]
        columns = [np.split(stored[name], ends) for name in ("boxes", "class_ids", "scores")]
        packed = stored["masks"]
    return tuple(
        Reference(Detections(boxes, class_ids, scores), unpacked(bits, height, width))
        for boxes, class_ids, scores, bits in zip(*columns, packed, strict=True)
    )


def unpacked(bits: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], height: int, width: int) -> BoolMask:
    """A packed mask, bool [height, width]."""
    return np.unpackbits(bits, count=height * width).reshape(height, width).view(np.bool_)
