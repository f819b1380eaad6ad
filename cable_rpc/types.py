"""Domain types shared by edge, cloud and study.

Conventions, everywhere in the package:

* images are uint8 ``[height, width, 3]`` in BGR order; masks are bool ``[height, width]``, True inside;
* pixel axes: x right, y down, origin at the top-left corner; boxes are ``xyxy`` in pixels, x_max/y_max exclusive;
* vehicle axes: x forward, y **right**, yaw positive to the **left** (counter-clockwise from above);
* times are integer nanoseconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
BoolMask = npt.NDArray[np.bool_]
UncertaintyMap = npt.NDArray[np.uint8]
"""uint8 [height, width], 0 = sure of the pixel's side of a mask, 255 = wholly undecided."""
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
class CameraMount:
    """Where a forward-looking camera without roll sits on its vehicle."""

    height_m: float
    """Optical centre above the road."""
    pitch_down_rad: float = 0.0
    """Tilt of the optical axis below the horizontal."""
    forward_m: float = 0.0
    """Optical centre ahead of the point whose motion `EgoMotion` tells (rear axle, GNSS antenna)."""


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
    ignored_boxes_xyxy: Float32Array | None = None
    """float32 [M, 4], regions that nobody annotated (KITTI's DontCare, COCO's crowds); a detection in one of them
    is neither right nor wrong."""

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
    mount: CameraMount | None = None

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
        pixels = mask.view(np.uint8)
        touched = np.zeros((rows, columns * block_size), np.uint8)
        whole = height // block_size
        bands = pixels[: whole * block_size].reshape(whole, block_size, width)
        np.bitwise_or.reduce(bands, axis=1, out=touched[:whole, :width])
        if whole < rows:
            np.bitwise_or.reduce(pixels[whole * block_size :], axis=0, out=touched[whole, :width])
        # Up to eight columns are compared at once, as one number.
        unit = math.gcd(block_size, 8)
        numbers = touched.view(f"u{unit}")
        step = block_size // unit
        blocks = numbers[:, ::step] != 0
        for offset in range(1, step):
            blocks |= numbers[:, offset::step] != 0
        return cls(blocks, block_size, height, width)

    def pixels(self) -> BoolMask:
        """bool [height, width]."""
        if self.block_size == 1:
            return self.blocks
        # Up to eight columns are written at once, as one number whose bytes are all 1.
        unit = math.gcd(self.block_size, 8)
        ones = np.array(int.from_bytes(b"\1" * unit, "little"), f"u{unit}")
        band_rows = np.multiply(self.blocks, ones, order="C")
        if self.block_size > unit:
            band_rows = band_rows.repeat(self.block_size // unit, axis=1)
        grown = band_rows.view(np.bool_).repeat(self.block_size, axis=0)
        pixels: BoolMask = grown[: self.height, : self.width]
        return pixels

    @property
    def coverage(self) -> float:
        """Share of the image's pixels inside the region, 0..1."""
        size = self.block_size
        inside = int(np.count_nonzero(self.blocks)) * size * size
        # What hangs over the border was counted too; the corner that hangs over both was taken off twice.
        below, beside = -self.height % size, -self.width % size
        inside -= int(np.count_nonzero(self.blocks[-1])) * below * size
        inside -= int(np.count_nonzero(self.blocks[:, -1])) * beside * size
        inside += int(self.blocks[-1, -1]) * below * beside
        return inside / (self.height * self.width)


@dataclass(frozen=True, slots=True)
class PrefillCost:
    """A language model's prefill of one frame beside that of the same frame whole, in three columns.

    The three belong together: the paper's quadratic estimate alone overstates what a model of billions of weights
    saves (`cable_rpc.study.prefill`).
    """

    prompt_tokens: int
    """n_p, tokens of the prompt besides the visual ones."""
    speedup_quadratic: float
    """The paper's estimate, ``((n_p + n_v) / n_in)^2``, by the tokens that really entered."""
    speedup_flops: float
    """Floating-point operations of the whole frame's prefill over those of this one's."""
    measured_ns: int
    """How long this prefill took."""
    whole_ns: int = 0
    """Prefill of a whole frame as measured on the same machine; 0 = none was seen yet."""

    @property
    def speedup_measured(self) -> float | None:
        """``whole_ns / measured_ns``; None as long as either is unknown."""
        return self.whole_ns / self.measured_ns if self.whole_ns > 0 and self.measured_ns > 0 else None


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
    uncertainty: UncertaintyMap | None = None
    """[height, width]; None = not told."""
    prefill: PrefillCost | None = None
    """None where there is no language model, or it tells nothing of its prefill."""
    stages_ns: Mapping[str, int] = field(default_factory=dict)
    """Parts of the segmenter's time by name, e.g. ``clip``, ``prefill``, ``sam_encoder``; they need not add up."""
    answer: str = ""
    """What the language model answered in words."""
    decoding: str = ""
    """How the answer came about in the segmenter's words, e.g. ``forced`` or ``generate``."""


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Durations of named processing stages of one frame, in nanoseconds of the local monotonic clock."""

    stages_ns: Mapping[str, int] = field(default_factory=dict)
