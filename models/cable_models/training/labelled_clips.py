"""Photographed clips with labels, as folders of the published data sets hold them, to judge a detector by."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.training.samples import LabelledImage

KITTI_CLASSES: Mapping[str, int] = {
    "Car": 2, "Van": 2, "Truck": 7, "Pedestrian": 0, "Person_sitting": 0, "Cyclist": 1,
}  # fmt: skip
"""Object types of KITTI tracking to COCO classes; the others are neither right nor wrong when found."""
KITTI_VISIBILITY: Mapping[str, float] = {"0": 1.0, "1": 0.7, "2": 0.4}
"""Column `occluded`: fully visible, partly, largely; 3 is unknown."""
OTHER = -1

CAMVID_CLASSES: Mapping[int, int] = {8: 2, 9: 0, 10: 1}
"""Ids of CamVid's eleven-class labels (car, pedestrian, bicyclist) to COCO classes."""
FEWEST_PIXELS = 40
"""Smaller patches of a class are no object."""


def read_clip(spec: str) -> list[LabelledImage]:
    """A clip named as ``kitti-tracking:FOLDER`` or ``camvid:FOLDER``.

    Raises:
        ModelError: another kind, or the folder holds no such clip.
    """
    kind, _, folder = spec.partition(":")
    readers = {"kitti-tracking": read_kitti_tracking, "camvid": read_camvid}
    if kind not in readers or not folder:
        raise ModelError(f"'{spec}' names no labelled clip; write {' or '.join(f'{name}:FOLDER' for name in readers)}")
    samples = readers[kind](Path(folder))
    if not samples:
        raise ModelError(f"{folder} holds no labelled frames of {kind}")
    return samples


def read_kitti_tracking(folder: Path) -> list[LabelledImage]:
    """All frames under ``training/image_02/SEQUENCE`` that are there, with ``training/label_02/SEQUENCE.txt``.

    Raises:
        ModelError: a file is missing or damaged.
    """
    samples: list[LabelledImage] = []
    for labels in sorted((folder / "training" / "label_02").glob("*.txt")):
        rows: dict[str, list[list[str]]] = {}
        for line in labels.read_text(encoding="utf-8").splitlines():
            columns = line.split()
            rows.setdefault(columns[0].zfill(6), []).append(columns)
        images = sorted((folder / "training" / "image_02" / labels.stem).glob("*.png"))
        try:
            samples += [kitti_sample(read_image(path), rows.get(path.stem, [])) for path in images]
        except (IndexError, ValueError) as error:
            raise ModelError(f"{labels} is no label file of KITTI tracking: {error}") from error
    return samples


def kitti_sample(image: Image, rows: list[list[str]]) -> LabelledImage:
    """One frame with its label rows: frame, track, type, truncated, occluded, alpha, left, top, right, bottom, ..."""
    class_ids = [KITTI_CLASSES.get(row[2], OTHER) for row in rows]
    seen = [
        KITTI_VISIBILITY.get(row[4], 0.0) if index != OTHER else 0.0 for row, index in zip(rows, class_ids, strict=True)
    ]
    boxes = np.array([[float(value) for value in row[6:10]] for row in rows], np.float32).reshape(-1, 4)
    return LabelledImage(image, boxes, np.array(class_ids, np.int32), np.array(seen, np.float32))


def read_camvid(folder: Path) -> list[LabelledImage]:
    """All frames under ``images`` with the class maps under ``labels``.

    Raises:
        ModelError: a file is missing or damaged.
    """
    samples = []
    for path in sorted((folder / "images").glob("*.png")):
        classes = cv2.imread(str(folder / "labels" / path.name), cv2.IMREAD_GRAYSCALE)
        if classes is None:
            raise ModelError(f"{path} has no class map of its name under labels/")
        samples.append(camvid_sample(read_image(path), np.asarray(classes, np.uint8)))
    return samples


def camvid_sample(image: Image, classes: npt.NDArray[np.uint8]) -> LabelledImage:
    """Boxes of connected patches: objects that touch are one, objects behind a pole are two."""
    boxes: list[list[int]] = []
    class_ids: list[int] = []
    for index, coco in CAMVID_CLASSES.items():
        _, _, statistics, _ = cv2.connectedComponentsWithStats((classes == index).astype(np.uint8), connectivity=8)
        for x, y, width, height, pixels in statistics[1:].tolist():
            if pixels >= FEWEST_PIXELS:
                boxes.append([x, y, x + width, y + height])
                class_ids.append(coco)
    corners = np.array(boxes, np.float32).reshape(-1, 4)
    return LabelledImage(image, corners, np.array(class_ids, np.int32), np.ones(len(class_ids), np.float32))


def read_image(path: Path) -> Image:
    """A colour image, uint8 [H, W, 3] BGR.

    Raises:
        ModelError: it can't be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ModelError(f"{path} can't be read as an image")
    return np.asarray(image, np.uint8)
