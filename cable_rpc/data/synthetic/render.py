"""One frame of the world: ground, shadows, everything from far to near, truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.actors import Actor
from cable_rpc.types import GroundTruth

Int32Array = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]

MIN_VISIBLE_PIXELS = 8


@dataclass(frozen=True, slots=True)
class Drawn:
    """An actor that was drawn with its id in the id image and its whole projected area."""

    actor: Actor
    ident: int
    area: float


def collect_truth(ids: Int32Array, drawn: list[Drawn]) -> GroundTruth:
    """Boxes, classes, tracks and visibility from the id image.

    Args:
        ids: int32 [H, W], identity seen at each pixel, 0 = none.
        drawn: The actors by identity.
    """
    seen = np.asarray(ids > 0, dtype=np.uint8)
    instance = np.zeros_like(ids)
    if not seen.any():
        return GroundTruth(
            np.zeros((0, 4), np.float32),
            np.zeros(0, np.int32),
            np.zeros(0, np.int32),
            np.zeros(0, np.float32),
            instance,
        )
    x, y = np.asarray(cv2.findNonZero(seen)).reshape(-1, 2).T
    values = ids[y, x]
    order = np.argsort(values.astype(np.uint16), kind="stable")
    values, x, y = values[order], x[order], y[order]
    starts = np.flatnonzero(np.r_[True, np.diff(values) != 0])
    counts = np.diff(np.r_[starts, len(values)])
    boxes = np.column_stack(
        [
            np.minimum.reduceat(x, starts),
            np.minimum.reduceat(y, starts),
            np.maximum.reduceat(x, starts) + 1,
            np.maximum.reduceat(y, starts) + 1,
        ]
    ).astype(np.float32)
    idents = values[starts]
    keep = counts >= MIN_VISIBLE_PIXELS
    by_ident = {one.ident: one for one in drawn}
    rows = [by_ident[int(ident)] for ident in idents[keep]]
    lookup = np.zeros(int(idents.max()) + 1, np.int32)
    lookup[idents[keep]] = np.arange(1, len(rows) + 1)
    instance = lookup[ids]
    areas = np.array([max(one.area, 1.0) for one in rows])
    return GroundTruth(
        boxes[keep],
        np.array([one.actor.class_id for one in rows], dtype=np.int32),
        np.array([one.actor.track_id for one in rows], dtype=np.int32),
        np.clip(counts[keep] / areas, 0.0, 1.0).astype(np.float32),
        instance,
    )
