"""Arrays as JSON values and back, without loss."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cable_rpc.study.metrics import RankedMatches


def counts_of(rows: Any, shape: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """An int64 array of nested lists."""
    return shaped(np.array(rows, np.int64), shape)


def shaped(array: npt.NDArray[Any], shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """The array, if it has that shape.

    Raises:
        ValueError: it has another.
    """
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} in place of {shape}")
    return array


def ranked_to_json(group: RankedMatches) -> dict[str, Any]:
    """One class group's detections."""
    return {
        "asked": group.asked,
        "scores": packed(group.scores, "<f4"),
        "correct": packed(group.correct, "<u2"),
        "excused": packed(group.excused, "<u2"),
    }


def ranked_from_json(content: Mapping[str, Any]) -> RankedMatches:
    """The inverse of `ranked_to_json`.

    Raises:
        ValueError: the lists are not equally long.
    """
    scores = unpacked(content["scores"], "<f4").astype(np.float32)
    correct = unpacked(content["correct"], "<u2").astype(np.uint16)
    excused = unpacked(content["excused"], "<u2").astype(np.uint16)
    if not len(scores) == len(correct) == len(excused):
        raise ValueError(f"{len(scores)} scores with {len(correct)} and {len(excused)} match flags")
    return RankedMatches(scores, correct, excused, int(content["asked"]))


def packed(array: npt.NDArray[Any], dtype: str) -> str:
    """A flat array's bytes, deflated, in base64."""
    return base64.b64encode(zlib.compress(array.astype(dtype).tobytes())).decode("ascii")


def unpacked(text: str, dtype: str) -> npt.NDArray[Any]:
    """The inverse of `packed`."""
    return np.frombuffer(zlib.decompress(base64.b64decode(text, validate=True)), dtype)
