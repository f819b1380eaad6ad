"""Recognises which of the two published RT-DETR export layouts an ONNX graph has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from cable_models.errors import ModelError

SignatureName = Literal["rtdetr", "transformers"]

DEFAULT_SIZE_WH = (640, 640)
FLOAT_DTYPES: Mapping[str, type[np.floating[Any]]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
}

ACCEPTED = (
    "'rtdetr': images float[N,3,H,W], orig_target_sizes int64[N,2] -> labels, boxes, scores; "
    "'transformers': pixel_values float[N,3,H,W] -> logits, pred_boxes"
)


class GraphArgument(Protocol):
    """One input or output as ONNX Runtime describes it."""

    name: str
    type: str
    shape: Sequence[int | str | None]


@dataclass(frozen=True, slots=True)
class Signature:
    """How to feed a detector graph and how to read its answer."""

    name: SignatureName
    image_input: str
    image_dtype: type[np.floating[Any]]
    size_wh: tuple[int, int]
    """Width and height that images are resized to."""
    fixed_batch: int | None
    """Batch size the graph insists on, None where it takes any."""
    class_count: int | None
    """Number of classes where the graph states it (last axis of the logits)."""


def read_signature(
    inputs: Sequence[GraphArgument], outputs: Sequence[GraphArgument], metadata: Mapping[str, str]
) -> Signature:
    """Matches names, types and shapes against the accepted layouts.

    Args:
        inputs: Graph inputs.
        outputs: Graph outputs.
        metadata: The model's metadata_props; ``input_width``/``input_height`` settle a dynamic image size,
            640x640 otherwise.

    Raises:
        ModelError: neither layout fits; the message lists what was found and what is accepted.
    """
    by_name = {argument.name: argument for argument in inputs}
    out_by_name = {argument.name: argument for argument in outputs}
    name: SignatureName
    if set(by_name) == {"images", "orig_target_sizes"} and {"labels", "boxes", "scores"} <= set(out_by_name):
        name, image = "rtdetr", by_name["images"]
        fits = by_name["orig_target_sizes"].type == "tensor(int64)"
    elif set(by_name) == {"pixel_values"} and {"logits", "pred_boxes"} <= set(out_by_name):
        name, image = "transformers", by_name["pixel_values"]
        fits = True
    else:
        raise unsupported(inputs, outputs)
    shape = list(image.shape)
    takes_rgb = len(shape) == 4 and (shape[1] == 3 or not isinstance(shape[1], int))
    if not fits or not takes_rgb or image.type not in FLOAT_DTYPES:
        raise unsupported(inputs, outputs)
    classes = out_by_name["logits"].shape[-1] if name == "transformers" else None
    return Signature(
        name=name,
        image_input=image.name,
        image_dtype=FLOAT_DTYPES[image.type],
        size_wh=(
            axis_size(shape[3], metadata, "input_width", DEFAULT_SIZE_WH[0]),
            axis_size(shape[2], metadata, "input_height", DEFAULT_SIZE_WH[1]),
        ),
        fixed_batch=shape[0] if isinstance(shape[0], int) else None,
        class_count=classes if isinstance(classes, int) else None,
    )


def axis_size(axis: int | str | None, metadata: Mapping[str, str], key: str, default: int) -> int:
    """Size of an image axis: what the graph fixes, else what its metadata says, else the default."""
    if isinstance(axis, int):
        return axis
    text = metadata.get(key, str(default))
    if not text.isdigit() or int(text) == 0:
        raise ModelError(f"the model's metadata {key!r} must be a positive whole number, got {text!r}")
    return int(text)


def unsupported(inputs: Sequence[GraphArgument], outputs: Sequence[GraphArgument]) -> ModelError:
    """The error for a graph that is no RT-DETR export."""

    def listed(arguments: Sequence[GraphArgument]) -> str:
        return ", ".join(f"{argument.name} {argument.type} {list(argument.shape)}" for argument in arguments)

    return ModelError(
        f"unsupported detector graph: found {listed(inputs)} -> {listed(outputs)}; accepted are {ACCEPTED}. "
        "Export the model again in one of these layouts"
    )
