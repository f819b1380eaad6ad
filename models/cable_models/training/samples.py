"""Labelled images on disk: JPEG files and one line of JSON each, appended while a renderer still runs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.detection import Float32Array, Image, Int32Array
from cable_models.errors import ModelError

LABEL_FILE = "labels.jsonl"
JPEG_QUALITY = 92


@dataclass(frozen=True, slots=True)
class LabelledImage:
    """One image with its objects."""

    image: Image
    """uint8 [height, width, 3] BGR."""
    boxes_xyxy: Float32Array
    """float32 [N, 4], pixels."""
    class_ids: Int32Array
    """int32 [N], contiguous COCO-80 indices."""
    visibility: Float32Array
    """float32 [N], visible share of each object, 0..1."""


@dataclass(frozen=True, slots=True)
class SampleEntry:
    """Where an image lies, and its labels."""

    path: Path
    boxes_xyxy: Float32Array
    class_ids: Int32Array
    visibility: Float32Array

    def load(self) -> LabelledImage:
        """Reads the image.

        Raises:
            ModelError: the file is gone or no image.
        """
        image = cv2.imread(str(self.path), cv2.IMREAD_COLOR)
        if image is None:
            raise ModelError(f"{self.path} can't be read as an image; render the training set again")
        return LabelledImage(np.asarray(image, np.uint8), self.boxes_xyxy, self.class_ids, self.visibility)


def append_sample(folder: Path, name: str, sample: LabelledImage) -> None:
    """Writes one image and appends its labels; ``folder`` must exist."""
    path = folder / f"{name}.jpg"
    cv2.imwrite(str(path), sample.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    record = {
        "image": path.name,
        "boxes_xyxy": np.round(sample.boxes_xyxy.astype(float), 2).tolist(),
        "class_ids": sample.class_ids.tolist(),
        "visibility": np.round(sample.visibility.astype(float), 3).tolist(),
    }
    with (folder / LABEL_FILE).open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(record) + "\n")


def read_entries(folder: Path) -> list[SampleEntry]:
    """All entries of a sample folder.

    Raises:
        ModelError: there is no label file, or a line of it is damaged.
    """
    path = folder / LABEL_FILE
    if not path.is_file():
        raise ModelError(f"{folder} has no {LABEL_FILE}; render a training set into it first")
    entries = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            record = json.loads(line)
            entries.append(
                SampleEntry(
                    folder / Path(record["image"]).name,
                    np.array(record["boxes_xyxy"], np.float32).reshape(-1, 4),
                    np.array(record["class_ids"], np.int32),
                    np.array(record["visibility"], np.float32),
                )
            )
        except (ValueError, KeyError, TypeError) as error:
            raise ModelError(f"line {number} of {path} is damaged: {error}") from error
    return entries


def learnable(
    boxes_xyxy: Float32Array, visibility: Float32Array, image_height: int, min_height: float, min_visibility: float
) -> npt.NDArray[np.bool_]:
    """Objects large and free enough to be taught or scored, bool [N].

    Args:
        boxes_xyxy: float32 [N, 4], pixels.
        visibility: float32 [N], 0..1.
        image_height: Height of the image the boxes belong to, pixels.
        min_height: Smallest box height as a share of the image height.
        min_visibility: Smallest visible share.
    """
    tall = (boxes_xyxy[:, 3] - boxes_xyxy[:, 1]) >= min_height * image_height
    return np.asarray(tall & (visibility >= min_visibility), np.bool_)
