"""Domain types shared by edge, cloud and study.

Conventions, everywhere in the package:

* images are uint8 ``[height, width, 3]`` in BGR order; masks are bool ``[height, width]``, True inside;
* pixel axes: x right, y down, origin at the top-left corner; boxes are ``xyxy`` in pixels, x_max/y_max exclusive;
* vehicle axes: x forward, y **right**, yaw positive to the **left** (counter-clockwise from above);
* times are integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
BoolMask = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
Int32Array = npt.NDArray[np.int32]

COCO_ROAD_USERS: Mapping[int, str] = {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
"""The paper's six classes by contiguous COCO-80 index, the class ids used throughout."""

CLASS_GROUPS: Mapping[int, str] = {
    0: "pedestrian",
    1: "cyclist",
    3: "cyclist",
    2: "vehicle",
    5: "vehicle",
    7: "vehicle",
}
"""Class id to the merged group in which detections are matched (a van called truck or car is one vehicle)."""


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """Pinhole camera, in pixels of the image it belongs to."""

    fx: float
    fy: float
    cx: float
    cy: float

    def scaled(self, factor_x: float, factor_y: float) -> CameraIntrinsics:
        """The same camera after resizing its image by the given factors."""
        return CameraIntrinsics(self.fx * factor_x, self.fy * factor_y, self.cx * factor_x, self.cy * factor_y)


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """Vehicle motion at a frame's capture time, in vehicle axes (x forward, y right, yaw positive left)."""

    speed_mps: float
    lateral_mps: float = 0.0
    yaw_rate_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class Detections:
    """Detected boxes of one frame, best score first where the detector sorts."""

    boxes_xyxy: Float32Array
    """float32 [N, 4], pixels of the full frame."""
    class_ids: Int32Array
    """int32 [N], contiguous COCO-80 indices."""
    scores: Float32Array
    """float32 [N], 0..1."""

    def __post_init__(self) -> None:
        count = len(self.class_ids)
        if self.boxes_xyxy.shape != (count, 4) or self.scores.shape != (count,):
            raise ValueError(
                "Detections need boxes [N, 4], class_ids [N] and scores [N], got "
                f"{self.boxes_xyxy.shape}, {self.class_ids.shape}, {self.scores.shape}"
            )

    def __len__(self) -> int:
        return len(self.class_ids)

    @classmethod
    def empty(cls) -> Detections:
        """No detections."""
        return cls(np.zeros((0, 4), np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32))

    def select(self, keep: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Detections:
        """The rows chosen by a boolean mask or by indices."""
        return Detections(self.boxes_xyxy[keep], self.class_ids[keep], self.scores[keep])


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Annotated objects of one frame."""

    boxes_xyxy: Float32Array
    """float32 [N, 4], visible extent in pixels, clipped to the image."""
    class_ids: Int32Array
    """int32 [N], contiguous COCO-80 indices."""
    track_ids: Int32Array
    """int32 [N], stable over a sequence."""
    visibility: Float32Array
    """float32 [N], visible share of the object's projected area, 0..1 (1 where the data set has no flag)."""
    instance_mask: npt.NDArray[np.int32] | None = None
    """int32 [height, width], row number + 1 of the object seen at each pixel, 0 = none of them."""

    def __len__(self) -> int:
        return len(self.class_ids)


@dataclass(frozen=True, slots=True)
class Frame:
    """One camera frame with everything known at its capture."""

    image: Image
    index: int
    capture_time_ns: int
    ego: EgoMotion | None = None
    intrinsics: CameraIntrinsics | None = None
    truth: GroundTruth | None = None

    @property
    def size_hw(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.image.shape[0], self.image.shape[1]


@dataclass(frozen=True, slots=True)
class RoiMask:
    """The region R_k on a grid of square blocks; exactly what travels with a frame and what both ends apply.

    ``block_size`` 1 is a pixel mask. Blocks at the right and bottom edge may hang over the image.
    """

    blocks: BoolMask
    """bool [rows, columns]."""
    block_size: int
    height: int
    width: int

    def __post_init__(self) -> None:
        size = self.block_size
        expected = (-(-self.height // size), -(-self.width // size))
        if self.blocks.shape != expected or self.blocks.dtype != np.bool_:
            raise ValueError(
                f"RoiMask of {self.width}x{self.height} in {size} px blocks needs bool {expected}, "
                f"got {self.blocks.dtype} {self.blocks.shape}"
            )

    @classmethod
    def full(cls, height: int, width: int, block_size: int = 8) -> RoiMask:
        """The whole frame."""
        shape = (-(-height // block_size), -(-width // block_size))
        return cls(np.ones(shape, np.bool_), block_size, height, width)

    @classmethod
    def from_pixels(cls, mask: BoolMask, block_size: int = 8) -> RoiMask:
        """The smallest block mask that covers a pixel mask (it only grows)."""
        height, width = mask.shape
        rows, columns = -(-height // block_size), -(-width // block_size)
        padded = np.zeros((rows * block_size, columns * block_size), np.bool_)
        padded[:height, :width] = mask
        # Two contiguous reductions; one over both axes of a 4-D view is six times slower.
        touched_rows = padded.reshape(rows, block_size, columns * block_size).any(axis=1)
        blocks = touched_rows.reshape(rows, columns, block_size).any(axis=2)
        return cls(np.asarray(blocks, np.bool_), block_size, height, width)

    def pixels(self) -> BoolMask:
        """bool [height, width]."""
        if self.block_size == 1:
            return self.blocks
        grown = self.blocks.repeat(self.block_size, axis=0).repeat(self.block_size, axis=1)
        pixels: BoolMask = grown[: self.height, : self.width]
        return pixels

    @property
    def coverage(self) -> float:
        """Share of the image's pixels inside the region, 0..1."""
        return float(self.pixels().mean())


@dataclass(frozen=True, slots=True)
class Segmentation:
    """A segmenter's answer for one frame."""

    mask: BoolMask
    """bool [height, width], True on road actors."""
    confidence: float
    """0..1, how sure the back end is of the mask as a whole."""
    tokens_in: int = 0
    """Visual tokens that entered the language model; 0 where there is none."""
    tokens_full: int = 0
    """Visual tokens that the full frame would have cost."""


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Durations of named processing stages of one frame, in nanoseconds of the local monotonic clock."""

    stages_ns: Mapping[str, int] = field(default_factory=dict)
