"""Exports RT-DETR to ONNX: a published checkpoint or the compact network of this package, by one way."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn
from transformers import RTDetrForObjectDetection

from cable_models.detection import DetectedBoxes, Image
from cable_models.errors import ModelError
from cable_models.rtdetr.checkpoints import Checkpoint, compact_checkpoint
from cable_models.rtdetr.compact import CompactRtDetrConfig
from cable_models.rtdetr.file_facts import metadata_of
from cable_models.rtdetr.file_plan import GraphOptions
from cable_models.rtdetr.labels import coco_index_table
from cable_models.rtdetr.postprocess import select_detections
from cable_models.rtdetr.verify import check_export, require, torch_answer


class LogitsAndBoxes(nn.Module):
    """The two tensors of the published transformers export, without the rest of the output object."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``logits`` [N, queries, classes] and ``pred_boxes`` [N, queries, 4]."""
        output = self.model(pixel_values=pixel_values)
        return output.logits, output.pred_boxes


class LabelsBoxesScores(nn.Module):
    """The original repository's signature: post-processing as in `decode_logits`, inside the graph."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, images: torch.Tensor, orig_target_sizes: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Best score first.

        Args:
            images: float [N, 3, H, W].
            orig_target_sizes: int64 [N, 2], width and height of each original image.

        Returns:
            ``labels`` int64 [N, queries], ``boxes`` [N, queries, 4] xyxy in pixels, ``scores`` [N, queries].
        """
        output = self.model(pixel_values=images)
        queries, classes = output.logits.shape[1:]
        best, index = torch.topk(output.logits.flatten(1), queries, dim=1)
        chosen = output.pred_boxes.gather(1, (index // classes).unsqueeze(-1).expand(-1, -1, 4))
        centre, half = chosen[..., :2], chosen[..., 2:] / 2
        scale = orig_target_sizes.to(chosen.dtype).repeat(1, 2).unsqueeze(1)
        boxes = torch.cat([centre - half, centre + half], dim=-1) * scale
        return index % classes, boxes, best.sigmoid()


def export_checkpoint(
    checkpoint: Checkpoint, path: Path, options: GraphOptions | None = None, notes: Mapping[str, str] | None = None
) -> None:
    """Writes the graph (image size fixed, batch free unless asked otherwise) with its facts in the metadata.

    Args:
        checkpoint: What to export.
        path: ONNX file to write.
        options: Form of the graph.
        notes: Further metadata.

    Raises:
        ModelError: the file can't be written.
    """
    options = options or GraphOptions()
    try:
        trace(checkpoint.model, checkpoint.recipe.size_wh, path, options)
        add_metadata(
            path,
            metadata_of(
                checkpoint.labels, checkpoint.recipe, {**checkpoint.notes, **tool_versions(options), **(notes or {})}
            ),
        )
    except OSError as error:
        raise ModelError(f"{path} can't be written: {error}") from error


def trace(model: nn.Module, size_wh: tuple[int, int], path: Path, options: GraphOptions) -> None:
    """Runs torch's exporter."""
    # two images, so that no axis of length 1 is taken for one to broadcast over
    pixels = torch.zeros(options.batch or 2, 3, size_wh[1], size_wh[0])
    if options.postprocess:
        network: nn.Module = LabelsBoxesScores(model)
        example: tuple[torch.Tensor, ...] = (pixels, torch.tensor([size_wh] * len(pixels)))
        names = (["images", "orig_target_sizes"], ["labels", "boxes", "scores"])
    else:
        network, example = LogitsAndBoxes(model), (pixels,)
        names = (["pixel_values"], ["logits", "pred_boxes"])
    axes = None if options.batch else {name: {0: "batch"} for name in (*names[0], *names[1])}
    exporter_log = logging.getLogger("torch.onnx")
    level = exporter_log.level
    exporter_log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            # it warns of every constant that it makes of the fixed image size, and of its own age
            warnings.simplefilter("ignore")
            # the exporter that is not based on dynamo: the newer one froze the batch at the example's size
            torch.onnx.export(
                network.train(False),
                example,
                str(path),
                input_names=names[0],
                output_names=names[1],
                dynamic_axes=axes,
                opset_version=options.opset,
                dynamo=False,
            )
    finally:
        exporter_log.setLevel(level)


def tool_versions(options: GraphOptions) -> dict[str, str]:
    """What made the file."""
    packages = {f"{name}_version": version(name) for name in ("torch", "transformers", "onnx")}
    return {"opset": str(options.opset), "precision": "fp32", **packages}


def add_metadata(path: Path, entries: Mapping[str, str]) -> None:
    """Adds or replaces metadata entries of an ONNX file, which is checked on the way.

    Raises:
        ModelError: the graph is not valid.
    """
    graph: Any = onnx.load(str(path))
    onnx.helper.set_model_props(graph, {**{entry.key: entry.value for entry in graph.metadata_props}, **entries})
    try:
        onnx.checker.check_model(graph)
    except onnx.checker.ValidationError as error:
        raise ModelError(f"{path} is no valid ONNX graph: {error}") from error
    onnx.save(graph, str(path))


def export_onnx(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, path: Path, notes: Mapping[str, str]
) -> None:
    """Exports a compact network; see `export_checkpoint`.

    Args:
        model: Trained model.
        config: Its size and labels.
        path: ONNX file to write.
        notes: Further metadata, such as ``source`` and ``licence``.
    """
    export_checkpoint(compact_checkpoint(model, config, notes), path)


def verify_export(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, path: Path, images: Sequence[Image]
) -> tuple[float, float]:
    """Compares a compact network with its exported file; see `check_export`.

    Returns:
        Largest difference of a box side in pixels, and of a score.

    Raises:
        ModelError: they differ by more than 0.5 px or 0.001, or one finds an object that the other doesn't.
    """
    check = check_export(compact_checkpoint(model, config, {}), path, images)
    require(check, path)
    return check.box_px, check.score


def detect_with_torch(
    model: RTDetrForObjectDetection, config: CompactRtDetrConfig, image: Image, min_score: float
) -> DetectedBoxes:
    """Detections of one image by a compact network, all COCO classes, without ONNX."""
    raw = torch_answer(compact_checkpoint(model, config, {}), image)
    return select_detections(
        raw.class_ids.astype(np.int64),
        raw.boxes_xyxy,
        raw.scores,
        coco_index=coco_index_table(dict(enumerate(config.labels))),
        wanted=np.ones(80, np.bool_),
        min_score=min_score,
        size_wh=(image.shape[1], image.shape[0]),
    )
