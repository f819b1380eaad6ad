"""One frame of the world: ground, shadows, everything from far to near, truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.actors import Actor
from cable_rpc.data.synthetic.raster import Window
from cable_rpc.types import GroundTruth

Int32Array = npt.NDArray[np.int32]

MIN_VISIBLE_PIXELS = 8


@dataclass(frozen=True, slots=True)
class Drawn:
    """An actor that was drawn with its id in the id image and its whole projected area."""

    actor: Actor
    ident: int
    area: float


def collect_truth(ids: Int32Array, drawn: list[Drawn], windows: dict[int, Window]) -> GroundTruth:
    """Boxes, classes, tracks and visibility from the id image.

    Args:
        ids: int32 [H, W], identity seen at each pixel, 0 = none.
        drawn: The actors, far to near.
        windows: The part of the image that each identity was drawn in.
    """
    instance = np.zeros_like(ids)
    rows: list[Drawn] = []
    boxes: list[tuple[int, int, int, int]] = []
    visibility: list[float] = []
    for one in sorted(drawn, key=lambda entry: entry.ident):
        window = windows.get(one.ident)
        if window is None:
            continue
        part = (slice(window.y0, window.y1), slice(window.x0, window.x1))
        own = ids[part] == one.ident
        seen = own.view(np.uint8)
        count = cv2.countNonZero(seen)
        if count < MIN_VISIBLE_PIXELS:
            continue
        x, y, width, height = cv2.boundingRect(seen)
        rows.append(one)
        np.copyto(instance[part], len(rows), where=own)
        boxes.append((window.x0 + x, window.y0 + y, window.x0 + x + width, window.y0 + y + height))
        visibility.append(min(count / max(one.area, 1.0), 1.0))
    return GroundTruth(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.array([one.actor.class_id for one in rows], dtype=np.int32),
        np.array([one.actor.track_id for one in rows], dtype=np.int32),
        np.array(visibility, dtype=np.float32),
        instance,
    )
