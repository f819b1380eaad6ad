"""Which objects of the truth are asked for, and how they are told apart: variants, class groups, sizes."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from cable_rpc.types import CLASS_GROUPS, GroundTruth, Int32Array

TruthVariant = Literal["all", "visible"]
"""``all``: every annotated object of a counted class; ``visible``: of those, the ones of `visible_truth`."""

TRUTH_VARIANTS: tuple[TruthVariant, ...] = ("all", "visible")

GROUPS = tuple(dict.fromkeys(CLASS_GROUPS.values()))
"""The merged classes in which detections and truth are compared, in the order of every array that has a group axis."""

SIZE_EDGES_PX = (25.0, 50.0, 100.0)
"""Box heights between the size bins, in pixels of the delivered image; 25 is the least height of `visible_truth`."""

SIZE_BINS = ("<25 px", "25-50 px", "50-100 px", ">=100 px")
"""Size bins by height of the box as clipped to the image, a bin's lower edge included.

Heights are not rescaled to a common number of lines: codecs, region masks and detectors all work on the pixels that
are delivered.
"""


def visible_truth(
    truth: GroundTruth, *, min_height_px: float = 25.0, min_visibility: float = 0.5
) -> npt.NDArray[np.bool_]:
    """Objects large and open enough to be asked for (the ``visible`` variant of the truth), bool [N]."""
    heights = truth.boxes_xyxy[:, 3] - truth.boxes_xyxy[:, 1]
    return (heights >= min_height_px) & (truth.visibility >= min_visibility)


def asked_truth(truth: GroundTruth, variant: TruthVariant) -> npt.NDArray[np.bool_]:
    """Objects of a counted class that a variant asks for, bool [N]."""
    known = group_indices(truth.class_ids) >= 0
    return known & visible_truth(truth) if variant == "visible" else known


def group_indices(class_ids: Int32Array) -> npt.NDArray[np.int64]:
    """Place in ``GROUPS`` of each class id, int64 [N]; -1 for a class outside the groups."""
    places = {class_id: GROUPS.index(group) for class_id, group in CLASS_GROUPS.items()}
    return np.array([places.get(int(class_id), -1) for class_id in class_ids], np.int64)


def size_bins(truth: GroundTruth) -> npt.NDArray[np.int64]:
    """Place in ``SIZE_BINS`` of each object, int64 [N]."""
    heights = truth.boxes_xyxy[:, 3] - truth.boxes_xyxy[:, 1]
    return np.searchsorted(SIZE_EDGES_PX, heights, side="right").astype(np.int64)
