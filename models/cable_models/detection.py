"""What a detector answers, in plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Float32Array = npt.NDArray[np.float32]
Int32Array = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class DetectedBoxes:
    """Objects found in one image, best score first."""

    boxes_xyxy: Float32Array
    """float32 [N, 4], pixels of the original image, x_max/y_max exclusive, clipped to the image."""
    class_ids: Int32Array
    """int32 [N], contiguous COCO-80 indices."""
    scores: Float32Array
    """float32 [N], 0..1."""

    def __len__(self) -> int:
        return len(self.class_ids)

    def select(self, keep: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> DetectedBoxes:
        """The rows chosen by a boolean mask or by indices."""
        return DetectedBoxes(self.boxes_xyxy[keep], self.class_ids[keep], self.scores[keep])
