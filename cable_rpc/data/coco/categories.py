"""Category names of annotation files to the class ids used throughout."""

from __future__ import annotations

import re
from collections.abc import Mapping

NAMES_BY_CLASS: Mapping[int, tuple[str, ...]] = {
    0: ("person", "pedestrian", "people", "walker"),
    1: ("bicycle", "cyclist", "bicyclist", "rider", "bike"),
    2: ("car", "van", "suv", "taxi", "vehicle", "passenger car", "minivan"),
    3: ("motorcycle", "motorbike", "motorcyclist", "moped", "scooter"),
    5: ("bus", "minibus", "coach"),
    7: ("truck", "lorry", "pickup", "pickup truck", "trailer", "construction vehicle", "construction"),
}
"""COCO-80 index to the names that mean it, in lower case with blanks between the words.

A trailer and a construction vehicle are what a detector trained on COCO calls a truck; all of them are one group.
"""

UNANNOTATED_NAMES = frozenset(
    {"dontcare", "dont care", "don't care", "ignore", "ignored", "ignored region", "ignored regions"}
)
"""Categories of regions that nobody annotated."""

CLASS_BY_NAME: Mapping[str, int] = {name: class_id for class_id, names in NAMES_BY_CLASS.items() for name in names}


def plain_name(name: str) -> str:
    """A category's name in lower case, with single blanks between its words."""
    return re.sub(r"[\s_\-]+", " ", name).strip().lower()


def class_of_category(name: str) -> int | None:
    """COCO-80 index of a category; None where it is none of the six road users.

    Case, hyphens and underscores don't matter. Of a dotted name (``vehicle.bus.rigid``) the first part from the right
    that is known counts.
    """
    parts = plain_name(name).split(".")
    return next((CLASS_BY_NAME[part] for part in reversed(parts) if part in CLASS_BY_NAME), None)


def is_unannotated(name: str) -> bool:
    """Whether a category marks regions that nobody annotated, such as KITTI's DontCare."""
    return plain_name(name) in UNANNOTATED_NAMES
