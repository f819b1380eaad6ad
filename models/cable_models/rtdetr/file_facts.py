"""What an exported detector's file says about itself, in ONNX metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from cable_models.errors import ModelError
from cable_models.rtdetr.labels import COCO80_NAMES, parse_labels
from cable_models.rtdetr.preprocess import InputRecipe, Resample, as_resample

RESAMPLE_KEY = "resample"


def labels_of(metadata: Mapping[str, str], class_count: int | None, path: Path) -> dict[int, str]:
    """Class names by model index: from metadata, else the COCO-80 list for an 80-class model.

    Raises:
        ModelError: the number of classes and of names differ.
    """
    labels = parse_labels(metadata["labels"]) if "labels" in metadata else dict(enumerate(COCO80_NAMES))
    if class_count is not None and class_count != len(labels):
        source = "its 'labels' metadata names" if "labels" in metadata else "COCO, assumed without metadata, has"
        raise ModelError(
            f"{path} has {class_count} classes but {source} {len(labels)}; add a metadata entry 'labels' "
            'with JSON {"0": "name", ...} for every class'
        )
    return labels


def recipe_of(metadata: Mapping[str, str], size_wh: tuple[int, int], resample: Resample | None) -> InputRecipe:
    """How to prepare images for a file; what it doesn't say is as in the published RT-DETR.

    Args:
        metadata: The file's metadata_props.
        size_wh: Width and height of the input.
        resample: A filter to use instead of the file's.

    Raises:
        ModelError: an entry can't be read.
    """
    filter_name = resample or as_resample(metadata.get(RESAMPLE_KEY, "antialias"))
    try:
        mean, std = (
            (float(r), float(g), float(b))
            for r, g, b in (
                json.loads(metadata.get(key, plain)) for key, plain in (("mean", "[0,0,0]"), ("std", "[1,1,1]"))
            )
        )
        return InputRecipe(size_wh, filter_name, float(metadata.get("rescale", 1 / 255)), mean, std)
    except (ValueError, TypeError) as error:
        raise ModelError(f"the model's preprocessing metadata (rescale, mean, std) can't be read: {error}") from error


def metadata_of(labels: Mapping[int, str], recipe: InputRecipe, notes: Mapping[str, str]) -> dict[str, str]:
    """The entries that `labels_of`, `recipe_of` and `read_signature` read, and further notes."""
    return {
        "labels": json.dumps(dict(labels)),
        "input_width": str(recipe.size_wh[0]),
        "input_height": str(recipe.size_wh[1]),
        "preprocessing": recipe.describe(),
        RESAMPLE_KEY: recipe.resample,
        "rescale": repr(recipe.rescale),
        "mean": json.dumps(recipe.mean),
        "std": json.dumps(recipe.std),
        **notes,
    }
