"""From a camera frame to the inputs of LISA's two image encoders, CLIP and SAM.

Both encoders were trained on PIL's resize, and both inputs are bit-exact with the original pre-processing
(dvlab-research/LISA, branch lisa_plus): a pixel off by one grey level is already another input. PIL resizes
each channel for itself, so the BGR frame is resized as it is and the channels change places only when the
normalised tensor is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PilImage

from cable_models.detection import Float32Array, Image
from cable_models.errors import ModelError

ClipFit = Literal["crop", "pad", "squash"]
Size = tuple[int, int]
"""(height, width) in pixels."""

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
"""RGB mean of OpenAI's CLIP, of values 0..1."""
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
SAM_MEAN = (123.675, 116.28, 103.53)
"""RGB mean of SAM, of values 0..255."""
SAM_STD = (58.395, 57.12, 57.375)


@dataclass(frozen=True, slots=True)
class ClipGeometry:
    """How the pixels of a frame map onto CLIP's square input; build it with `clip_geometry`.

    The frame is first set into a canvas (larger than the frame for "pad" only), the canvas is resized, and a
    square of ``size`` is cut out of the result (smaller than the result for "crop" only).
    """

    fit: ClipFit
    frame: Size
    """(H, W) of the frame."""
    size: int
    """Side S of CLIP's input."""
    canvas: Size
    """(height, width) of what is resized, in frame pixels."""
    padding: Size
    """(top, left) position of the frame in the canvas, in frame pixels."""
    resized: Size
    """(height, width) of the canvas after the resize, in CLIP pixels."""
    crop: Size
    """(top, left) corner of CLIP's square in the resized canvas, in CLIP pixels."""

    def frame_y(self, clip_y: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Rows of CLIP's input (pixel edges, 0..S) as rows of the frame; outside 0..H where CLIP sees padding."""
        return self._to_frame(clip_y, axis=0)

    def frame_x(self, clip_x: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Columns of CLIP's input (pixel edges, 0..S) as columns of the frame; outside 0..W in the padding."""
        return self._to_frame(clip_x, axis=1)

    def _to_frame(self, position: npt.ArrayLike, axis: Literal[0, 1]) -> npt.NDArray[np.float64]:
        in_resized = np.asarray(position, np.float64) + self.crop[axis]
        return in_resized * self.canvas[axis] / self.resized[axis] - self.padding[axis]

    def patch_edges(self, patch_size: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Borders of CLIP's patches in the frame.

        Args:
            patch_size: Side of a patch in CLIP pixels. A remainder of S that fills no patch is not seen by CLIP.

        Returns:
            float64 [rows + 1] frame rows and float64 [columns + 1] frame columns, in frame pixels, not clipped.
        """
        if not 0 < patch_size <= self.size:
            raise ModelError(f"a patch of {patch_size} pixels doesn't fit CLIP's input of {self.size} pixels")
        edges = np.arange(self.size // patch_size + 1) * patch_size
        return self.frame_y(edges), self.frame_x(edges)


def clip_geometry(frame: Size, size: int, fit: ClipFit = "crop") -> ClipGeometry:
    """The geometry of one frame size and fit.

    Args:
        frame: (H, W) of the frame.
        size: Side of CLIP's input.
        fit: "crop" is the released behaviour: short side to ``size``, centre square; on a wide frame CLIP doesn't
            see the sides. "pad" centres the whole frame in a square of CLIP's mean colour (LLaVA-1.5). "squash"
            resizes the whole frame to the square without keeping its proportions.

    Raises:
        ModelError: an empty frame, a size below 1, or an unknown fit.
    """
    height, width = frame
    if min(height, width, size) < 1:
        raise ModelError(f"frame {width}x{height} and CLIP input {size} must have at least one pixel")
    if fit == "crop":
        # Truncated, not rounded, as the original's resize and crop are.
        short = min(height, width)
        resized = (int(size * height / short), int(size * width / short))
        crop = ((resized[0] - size) // 2, (resized[1] - size) // 2)
        return ClipGeometry(fit, frame, size, frame, (0, 0), resized, crop)
    if fit == "pad":
        side = max(height, width)
        padding = ((side - height) // 2, (side - width) // 2)
        return ClipGeometry(fit, frame, size, (side, side), padding, (size, size), (0, 0))
    if fit == "squash":
        return ClipGeometry(fit, frame, size, frame, (0, 0), (size, size), (0, 0))
    raise ModelError(f"unknown CLIP fit {fit!r}; choose one of {', '.join(get_args(ClipFit))}")


def clip_input(
    image: Image, geometry: ClipGeometry, mean: Sequence[float] = CLIP_MEAN, std: Sequence[float] = CLIP_STD
) -> Float32Array:
    """CLIP's input of one frame: PIL bicubic, /255, mean and deviation.

    Args:
        image: uint8 [H, W, 3] BGR, of the size ``geometry`` was made for.
        geometry: Mapping of the frame onto CLIP's square.
        mean: RGB, of values 0..1; also the colour of the padding.
        std: RGB, of values 0..1.

    Returns:
        float32 [3, S, S], RGB.

    Raises:
        ModelError: the image isn't uint8 [H, W, 3] or has another size.
    """
    check_frame(image)
    if image.shape[:2] != geometry.frame:
        raise ModelError(f"image {image.shape[:2]} doesn't have the size {geometry.frame} of its CLIP geometry")
    seen = clip_resize(image, geometry, [int(value * 255) for value in reversed(mean)])
    # The original scales in double precision, rounds to single, then normalises in single precision.
    unit = (np.arange(256) * (1 / 255)).astype(np.float32)
    tensor = np.empty((3, geometry.size, geometry.size), np.float32)
    write_normalised(seen, unit, mean, std, tensor)
    return tensor


def sam_size(frame: Size, size: int) -> Size:
    """(h, w) of a frame after scaling its long side to ``size``, each side rounded half up.

    Raises:
        ModelError: an empty frame, or one so narrow that nothing of it would be left.
    """
    if min(*frame, size) < 1:
        raise ModelError(f"frame {frame[1]}x{frame[0]} and SAM input {size} must have at least one pixel")
    scale = size / max(frame)
    height, width = (int(side * scale + 0.5) for side in frame)
    if min(height, width) < 1:
        raise ModelError(f"frame {frame[1]}x{frame[0]} is too narrow: nothing is left of it at SAM's {size} pixels")
    return height, width


def sam_input(image: Image, size: int) -> tuple[Float32Array, Size]:
    """SAM's input of one frame: PIL bilinear with antialias, mean and deviation, then zeros right and below.

    Args:
        image: uint8 [H, W, 3] BGR.
        size: Side S of SAM's square input (1024 in the released model).

    Returns:
        float32 [3, S, S] RGB, and the (h, w) of its top-left part that holds the picture.

    Raises:
        ModelError: the image isn't uint8 [H, W, 3], or is too narrow.
    """
    check_frame(image)
    height, width = sam_size((image.shape[0], image.shape[1]), size)
    resized = pil_resize(image, (height, width), PilImage.Resampling.BILINEAR)
    tensor = np.empty((3, size, size), np.float32)
    tensor[:, height:] = 0
    tensor[:, :height, width:] = 0
    write_normalised(resized, np.arange(256, dtype=np.float32), SAM_MEAN, SAM_STD, tensor[:, :height, :width])
    return tensor, (height, width)


def check_frame(image: Image) -> None:
    """Refuses anything but a non-empty uint8 [H, W, 3] array.

    Raises:
        ModelError: wrong type, dtype or shape.
    """
    is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8
    if not is_image or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ModelError(f"a frame must be uint8 [height, width, 3] in BGR order, got {found}")


def clip_resize(image: Image, geometry: ClipGeometry, border: Sequence[int]) -> Image:
    """What CLIP sees, in grey levels: uint8 [S, S, 3] BGR.

    The frame is resized along its rows and its columns one after the other, so that the rows of padding stay out
    of the first, costly pass and the columns that are cut away out of the second.

    Args:
        image: uint8 [H, W, 3] BGR.
        geometry: Mapping of the frame onto CLIP's square.
        border: BGR colour of the padding.
    """
    (top, left), (crop_top, crop_left), size = geometry.padding, geometry.crop, geometry.size
    height, width = geometry.canvas
    image = with_border(image, (0, left), (image.shape[0], width), border)
    image = pil_resize(image, (image.shape[0], geometry.resized[1]), PilImage.Resampling.BICUBIC)
    image = with_border(image[:, crop_left : crop_left + size], (top, 0), (height, size), border)
    image = pil_resize(image, (geometry.resized[0], size), PilImage.Resampling.BICUBIC)
    return image[crop_top : crop_top + size]


def with_border(image: Image, corner: Size, size: Size, colour: Sequence[int]) -> Image:
    """The image with its top-left corner at ``corner`` of a one-coloured image of the given size."""
    if image.shape[:2] == size:
        return image
    canvas = np.empty((*size, 3), np.uint8)
    canvas[:] = colour
    (top, left), (height, width) = corner, image.shape[:2]
    canvas[top : top + height, left : left + width] = image
    return canvas


def pil_resize(image: Image, size: Size, resample: PilImage.Resampling) -> Image:
    """PIL's resize with antialias: along the rows, rounded to uint8, then along the columns.

    Up to version 12, Pillow does so by itself; from 13 on it turns the two passes round for some tall images, which
    gives other grey levels.
    """
    if image.shape[:2] == size:
        return image
    height, width = image.shape[:2]
    resized = PilImage.fromarray(image)
    if width != size[1]:
        resized = resized.resize((size[1], height), resample)
    if height != size[0]:
        resized = resized.resize((size[1], size[0]), resample)
    return np.asarray(resized)


def write_normalised(
    image: Image, levels: Float32Array, mean: Sequence[float], std: Sequence[float], out: Float32Array
) -> None:
    """Writes ``(levels[grey] - mean) / std`` through one table of 256 entries per channel.

    Args:
        image: uint8 [h, w, 3] BGR.
        levels: float32 [256], the value of each grey level before normalising.
        mean: RGB, in units of ``levels``.
        std: RGB, in units of ``levels``.
        out: float32 [3, h, w] RGB, overwritten.
    """
    for plane, source, channel_mean, channel_std in zip(out, (2, 1, 0), mean, std, strict=True):
        table = (levels - np.float32(channel_mean)) / np.float32(channel_std)
        plane[:] = cv2.LUT(cv2.extractChannel(image, source), table)
