"""Images with instance masks on disk: the detector's sample folder, and a PNG of instance numbers beside each JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cable_models.detection import Image, Int32Array
from cable_models.errors import ModelError
from cable_models.training.samples import LABEL_FILE, LabelledImage, append_sample, read_entries

CLASS_NAMES = ("vehicle", "pedestrian", "cyclist")
"""Class number c of a class map is ``CLASS_NAMES[c - 1]``; 0 is background."""

CLASS_OF_COCO = {2: 1, 5: 1, 7: 1, 0: 2, 1: 3, 3: 3}
"""COCO-80 index to the class number of a class map."""

ClassMap = npt.NDArray[np.uint8]
InstanceMap = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class SegmentedImage:
    """One image with the object at every pixel."""

    image: Image
    """uint8 [height, width, 3] BGR."""
    instances: InstanceMap
    """uint16 [height, width], row of ``table``, 0 = no object."""
    table: ClassMap
    """uint8 [1 + N], class number of every instance number; 0 is background."""

    @property
    def classes(self) -> ClassMap:
        """uint8 [height, width], 0 background, else 1 + index in `CLASS_NAMES`."""
        return self.table[self.instances]


@dataclass(frozen=True, slots=True)
class SegmentedEntry:
    """Where an image and its instance numbers lie."""

    image_path: Path
    class_ids: Int32Array
    """int32 [N], COCO-80 index of instance 1 .. N."""

    def load(self) -> SegmentedImage:
        """Reads image and classes.

        Raises:
            ModelError: a file is gone, no image, or of another size than its partner.
        """
        image = cv2.imread(str(self.image_path), cv2.IMREAD_COLOR)
        instances = cv2.imread(str(instance_path(self.image_path)), cv2.IMREAD_UNCHANGED)
        if image is None or instances is None or image.shape[:2] != instances.shape:
            raise ModelError(
                f"{self.image_path} and {instance_path(self.image_path).name} aren't an image and its instance "
                "numbers; delete both and render again"
            )
        table = class_table(self.class_ids)
        if int(instances.max()) >= len(table):
            raise ModelError(
                f"{instance_path(self.image_path)} has instance {int(instances.max())}, {LABEL_FILE} lists "
                f"{len(table) - 1}; delete the folder and render again"
            )
        return SegmentedImage(np.asarray(image, np.uint8), np.asarray(instances, np.uint16), table)

    @property
    def classes_present(self) -> frozenset[int]:
        """Class numbers of the objects in the image."""
        return frozenset(CLASS_OF_COCO[int(index)] for index in self.class_ids if int(index) in CLASS_OF_COCO)


def instance_path(image_path: Path) -> Path:
    """The PNG of instance numbers (uint16, row number + 1) that belongs to an image."""
    return image_path.with_suffix(".ids.png")


def class_table(class_ids: Int32Array) -> ClassMap:
    """Class number of every instance number, uint8 [N + 1]; other classes count as background."""
    return np.array([0] + [CLASS_OF_COCO.get(int(index), 0) for index in class_ids], np.uint8)


def append_segmented(folder: Path, name: str, sample: LabelledImage, instances: npt.NDArray[np.int32]) -> None:
    """Writes one image with its labels and instance numbers; ``folder`` must exist.

    Args:
        folder: Sample folder.
        name: File name without extension.
        sample: Image, boxes and classes.
        instances: int32 [height, width], row number in ``sample`` + 1, 0 = none of them.
    """
    cv2.imwrite(str(instance_path(folder / f"{name}.jpg")), instances.astype(np.uint16))
    append_sample(folder, name, sample)


def read_segmented(folder: Path) -> list[SegmentedEntry]:
    """All entries of a sample folder.

    Raises:
        ModelError: there is no label file, or a line of it is damaged.
    """
    return [SegmentedEntry(entry.path, entry.class_ids) for entry in read_entries(folder)]
