"""Class names of detectors and their contiguous COCO-80 indices."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from cable_models.detection import Int32Array
from cable_models.errors import ModelError

COCO80_NAMES: tuple[str, ...] = (
    "person",
    "bicycle",
    "car",
    "motorcycle",
    "airplane",
    "bus",
    "train",
    "truck",
    "boat",
    "traffic light",
    "fire hydrant",
    "stop sign",
    "parking meter",
    "bench",
    "bird",
    "cat",
    "dog",
    "horse",
    "sheep",
    "cow",
    "elephant",
    "bear",
    "zebra",
    "giraffe",
    "backpack",
    "umbrella",
    "handbag",
    "tie",
    "suitcase",
    "frisbee",
    "skis",
    "snowboard",
    "sports ball",
    "kite",
    "baseball bat",
    "baseball glove",
    "skateboard",
    "surfboard",
    "tennis racket",
    "bottle",
    "wine glass",
    "cup",
    "fork",
    "knife",
    "spoon",
    "bowl",
    "banana",
    "apple",
    "sandwich",
    "orange",
    "broccoli",
    "carrot",
    "hot dog",
    "pizza",
    "donut",
    "cake",
    "chair",
    "couch",
    "potted plant",
    "bed",
    "dining table",
    "toilet",
    "tv",
    "laptop",
    "mouse",
    "remote",
    "keyboard",
    "cell phone",
    "microwave",
    "oven",
    "toaster",
    "sink",
    "refrigerator",
    "book",
    "clock",
    "vase",
    "scissors",
    "teddy bear",
    "hair drier",
    "toothbrush",
)
"""The 80 detection classes of COCO in their contiguous order."""

ALIASES: Mapping[str, str] = {
    "pedestrian": "person",
    "cyclist": "bicycle",
    "rider": "bicycle",
    "motorbike": "motorcycle",
    "motorcyclist": "motorcycle",
    "van": "car",
    "lorry": "truck",
    "aeroplane": "airplane",
    "sofa": "couch",
    "pottedplant": "potted plant",
    "diningtable": "dining table",
    "tvmonitor": "tv",
}
"""Other names (driving data sets; the published RT-DETR checkpoints) to the COCO name that stands for them here."""

COCO_GROUP_OF: Mapping[int, int] = {0: 0, 1: 1, 3: 1, 2: 2, 5: 2, 7: 2}
"""Class id to the group in which one object may carry several labels: pedestrian, cyclist, vehicle."""

NOT_COCO = -1


def parse_labels(text: str) -> dict[int, str]:
    """Reads the ``labels`` metadata entry, a JSON object ``{"index": "name"}``.

    Raises:
        ModelError: the entry is no such object, or its indices are not 0..n-1.
    """
    try:
        entries = {int(index): str(name) for index, name in json.loads(text).items()}
    except (ValueError, AttributeError) as error:
        raise ModelError(f"the model's 'labels' metadata must be JSON {{index: name}}, got {text[:80]!r}") from error
    if sorted(entries) != list(range(len(entries))):
        raise ModelError(f"the model's 'labels' metadata must number its classes 0..n-1, got {sorted(entries)}")
    return entries


def coco_index_table(labels: Mapping[int, str]) -> Int32Array:
    """Maps model class index to COCO-80 index, int32 [classes]; ``NOT_COCO`` where COCO has no such class."""
    index_of = {name: index for index, name in enumerate(COCO80_NAMES)}
    names = [labels[index].lower() for index in range(len(labels))]
    return np.array([index_of.get(ALIASES.get(name, name), NOT_COCO) for name in names], np.int32)


def group_ids(class_ids: Int32Array) -> Int32Array:
    """Group of each COCO class, int32 [N]; classes outside the road-user groups are groups of their own."""
    table = np.arange(len(COCO80_NAMES), dtype=np.int32) + len(COCO_GROUP_OF)
    table[list(COCO_GROUP_OF)] = list(COCO_GROUP_OF.values())
    return np.asarray(table[class_ids], np.int32)
