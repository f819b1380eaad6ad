"""Categories of nuScenes and Lyft Level 5 as the six classes used throughout."""

from __future__ import annotations

from collections.abc import Mapping

PERSON, BICYCLE, CAR, MOTORCYCLE, BUS, TRUCK = 0, 1, 2, 3, 5, 7
CLASSES: Mapping[str, int] = {
    "human.pedestrian": PERSON,
    "vehicle.bicycle": BICYCLE,
    "vehicle.car": CAR,
    "vehicle.motorcycle": MOTORCYCLE,
    "vehicle.bus": BUS,
    "vehicle.truck": TRUCK,
    "vehicle.trailer": TRUCK,
    "vehicle.construction": TRUCK,
    "pedestrian": PERSON,
    "bicycle": BICYCLE,
    "car": CAR,
    "motorcycle": MOTORCYCLE,
    "bus": BUS,
    "truck": TRUCK,
    "other_vehicle": TRUCK,
}
"""Category, or the part of it before a further period, to COCO-80 index; those without a prefix are Lyft's."""
IGNORED = ("vehicle.emergency", "static_object.bicycle_rack", "emergency_vehicle")
"""Road users whose class is not told (a police car or an ambulance), and racks whose bicycles nobody annotated."""


def class_of_category(name: str) -> int | None:
    """COCO-80 index of a category such as ``vehicle.bus.rigid``; None where it is none of the six."""
    return next((index for prefix, index in CLASSES.items() if is_a(name, prefix)), None)


def is_ignored(name: str) -> bool:
    """Whether a detection on such an object is neither right nor wrong."""
    return any(is_a(name, prefix) for prefix in IGNORED)


def is_a(name: str, prefix: str) -> bool:
    """Whether a category is another one or one of its subcategories."""
    return name == prefix or name.startswith(prefix + ".")
