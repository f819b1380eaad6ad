"""RT-DETR checkpoints: from a folder, from the Hugging Face hub, or the compact one of this package's training."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
import transformers
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_model
from torch import nn

from cable_models.errors import ModelError
from cable_models.rtdetr.compact import CompactRtDetrConfig, build_compact_rtdetr
from cable_models.rtdetr.hub import Located, locate
from cable_models.rtdetr.preprocess import InputRecipe

ARCHITECTURES: Mapping[str, str] = {
    "rt_detr": "RTDetrForObjectDetection",
    "rt_detr_v2": "RTDetrV2ForObjectDetection",
}
"""``model_type`` of a checkpoint's config.json to the class of transformers."""

STRIDE = 32
"""The coarsest feature map's; input sides are multiples of it."""
PIL_BILINEAR = 2
COMPACT_KEY = "compact_rtdetr"
"""Entry of a safetensors file's metadata with the `CompactRtDetrConfig` as JSON; without it, the defaults."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A network with all that an export has to know of it."""

    model: nn.Module
    """``pixel_values`` float32 [N, 3, H, W] to an output with ``logits`` and ``pred_boxes``; in evaluation mode."""
    labels: Mapping[int, str]
    recipe: InputRecipe
    notes: Mapping[str, str]
    """For the file's metadata: architecture, source, revision."""

    def resized(self, size_wh: tuple[int, int]) -> Checkpoint:
        """The same for another input size.

        Raises:
            ModelError: a side is no multiple of 32.
        """
        if any(side < STRIDE or side % STRIDE for side in size_wh):
            raise ModelError(
                f"the input of RT-DETR needs sides in multiples of {STRIDE}, got {size_wh[0]}x{size_wh[1]}"
            )
        return replace(self, recipe=replace(self.recipe, size_wh=size_wh))


def load_checkpoint(name: str, revision: str | None = None) -> Checkpoint:
    """Loads a checkpoint by name.

    Args:
        name: Folder written by ``save_pretrained``, hub id such as ``PekingU/rtdetr_r50vd``, or a compact
            checkpoint (its safetensors file, or the folder with nothing but it).
        revision: Commit, tag or branch, for the hub.

    Raises:
        ModelError: nothing there, the hub can't be reached, or it is no RT-DETR.
    """
    located = locate(name, revision)
    with warnings.catch_warnings():
        # advice on head sizes, for those who choose them
        warnings.simplefilter("ignore", UserWarning)
        return load_compact(located) if located.path.is_file() else load_transformers(located)


def compact_checkpoint(model: nn.Module, config: CompactRtDetrConfig, notes: Mapping[str, str]) -> Checkpoint:
    """A compact network as a checkpoint."""
    architecture = {"architecture": "RT-DETR (RTDetrForObjectDetection of transformers), compact configuration"}
    return Checkpoint(
        model, dict(enumerate(config.labels)), InputRecipe(config.input_size_wh), {**architecture, **notes}
    )


def load_compact(located: Located) -> Checkpoint:
    """The compact network from a safetensors file.

    Raises:
        ModelError: it belongs to another network.
    """
    path = located.path
    try:
        with safe_open(path, framework="pt") as file:
            config = compact_config((file.metadata() or {}).get(COMPACT_KEY))
        model = build_compact_rtdetr(config)
        load_model(model, str(path))
    except (OSError, RuntimeError, SafetensorError) as error:
        raise ModelError(
            f"{path} holds no weights of the compact RT-DETR ({str(error)[:200]}); a checkpoint of transformers is "
            "named by its folder, with config.json in it"
        ) from error
    return compact_checkpoint(model.train(False), config, {"source": located.source, "revision": located.revision})


def compact_config(text: str | None) -> CompactRtDetrConfig:
    """The size of a compact network from JSON; the defaults where there is none.

    Raises:
        ModelError: it can't be read.
    """
    if text is None:
        return CompactRtDetrConfig()
    try:
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in json.loads(text).items()
        }
        return CompactRtDetrConfig(**values)
    except (ValueError, TypeError, AttributeError) as error:
        raise ModelError(f"the '{COMPACT_KEY}' entry of the weights can't be read: {error}") from error


def load_transformers(located: Located) -> Checkpoint:
    """A folder of transformers.

    Raises:
        ModelError: not an RT-DETR, weights missing or not fitting, preprocessing that isn't RT-DETR's.
    """
    folder = located.path
    config = read_json(folder / "config.json")
    model_type = str(config.get("model_type"))
    if model_type not in ARCHITECTURES:
        raise ModelError(
            f"{located.source} is a '{model_type}' model, not an RT-DETR ({', '.join(ARCHITECTURES)}); "
            "another detector can be served as onnx:FILE if its export has one of the two RT-DETR signatures"
        )
    model_class = getattr(transformers, ARCHITECTURES[model_type])
    words: Any = transformers.utils.logging
    progress_bar = words.is_progress_bar_enabled()
    words.disable_progress_bar()
    try:
        model, report = model_class.from_pretrained(
            str(folder),
            local_files_only=True,
            output_loading_info=True,
            # anchors and position embeddings then follow the input instead of a size fixed in the checkpoint
            anchor_image_size=None,
            eval_size=None,
            dtype=torch.float32,
        )
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        raise ModelError(f"{located.source} can't be loaded as {ARCHITECTURES[model_type]}: {error}") from error
    finally:
        if progress_bar:
            words.enable_progress_bar()
    missing = sorted(report["missing_keys"])
    if missing:
        raise ModelError(
            f"{located.source} lacks {len(missing)} weights of {ARCHITECTURES[model_type]}, {missing[0]} the first; "
            "its answers would be random"
        )
    recipe = recipe_from_processor(processor_config(folder))
    labels = {int(index): str(label) for index, label in model.config.id2label.items()}
    notes = {
        "architecture": f"{ARCHITECTURES[model_type]} of transformers",
        "source": located.source,
        "revision": located.revision,
    }
    return Checkpoint(cast(nn.Module, model).train(False), labels, recipe, notes).resized(recipe.size_wh)


def processor_config(folder: Path) -> Mapping[str, Any]:
    """The image processor's settings; empty where the folder has none (RT-DETR's defaults then hold)."""
    path = folder / "preprocessor_config.json"
    if path.is_file():
        return read_json(path)
    path = folder / "processor_config.json"
    if path.is_file():
        return cast(Mapping[str, Any], read_json(path).get("image_processor", {}))
    return {}


def recipe_from_processor(config: Mapping[str, Any]) -> InputRecipe:
    """Translates the settings of ``RTDetrImageProcessor``.

    Raises:
        ModelError: they ask for something that this package doesn't do.
    """
    size = config.get("size") or {"height": 640, "width": 640}
    if not {"height", "width"} <= set(size):
        raise ModelError(f"the processor resizes to {size}; only a straight resize to a height and width is supported")
    resample = config.get("resample", PIL_BILINEAR)
    if resample != PIL_BILINEAR:
        raise ModelError(f"the processor resizes with Pillow's filter {resample}; only bilinear (2) is supported")
    if not config.get("do_resize", True):
        raise ModelError("the processor doesn't resize; the input size of RT-DETR must be fixed in its 'size'")
    normalise = config.get("do_normalize", False)
    mean, std = (
        config.get(key, plain) if normalise else neutral
        for key, plain, neutral in (
            ("image_mean", (0.485, 0.456, 0.406), (0.0, 0.0, 0.0)),
            ("image_std", (0.229, 0.224, 0.225), (1.0, 1.0, 1.0)),
        )
    )
    rescale = float(config.get("rescale_factor", 1 / 255)) if config.get("do_rescale", True) else 1.0
    return InputRecipe(
        (int(size["width"]), int(size["height"])),
        "antialias",
        rescale,
        (float(mean[0]), float(mean[1]), float(mean[2])),
        (float(std[0]), float(std[1]), float(std[2])),
    )


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        ModelError: the file is no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} can't be read: {error}") from error
    if not isinstance(value, dict):
        raise ModelError(f"{path} must hold a JSON object")
    return value
