"""What one frame hands to the network: the inputs of both image encoders, and the parts of them that are computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from cable_models.detection import Image
from cable_models.errors import ModelError
from cable_models.lisa.architecture import ClipPreprocessing
from cable_models.lisa.device_images import clip_input_on_device, sam_input_on_device
from cable_models.lisa.images import ClipGeometry, Size, check_frame, clip_geometry, clip_input, sam_input
from cable_models.lisa.options import LisaOptions
from cable_models.lisa.patch_selection import kept_patches
from cable_models.lisa.sam_plan import SamGrid, SamPlan, plan_sam

BoolMask = npt.NDArray[np.bool_]

CPU = torch.device("cpu")


@dataclass(frozen=True, slots=True)
class FrameInput:
    """One frame, ready for the network."""

    frame_hw: Size
    clip_pixels: torch.Tensor
    """float32 [3, S, S], on the model's device."""
    kept_patches: npt.NDArray[np.int64] | None
    """int64 [n], row-major numbers of the CLIP patches whose tokens enter the language model; None = all."""
    sam_pixels: torch.Tensor
    """float32 [3, S, S], on the model's device."""
    sam_hw: Size
    """The part of SAM's input that holds the picture."""
    sam_plan: SamPlan


def prepare_frame(
    image: Image,
    roi: BoolMask | None,
    preprocessing: ClipPreprocessing,
    patch_size: int,
    grid: SamGrid,
    options: LisaOptions,
    device: torch.device = CPU,
) -> FrameInput:
    """Scales a frame for CLIP and SAM, and decides what of it is computed.

    Args:
        image: uint8 [H, W, 3] BGR.
        roi: bool [H, W], R_k; None or all True = the whole frame, of which nothing is left out.
        preprocessing: CLIP's input.
        patch_size: Side of CLIP's patches, pixels of its input.
        grid: Sizes of SAM's image encoder.
        options: Switches.
        device: Where the model is; a GPU scales the frame itself, to the same pixels.

    Raises:
        ModelError: the image or the region is of another kind.
    """
    check_frame(image)
    height, width = image.shape[:2]
    if roi is not None and (roi.shape != (height, width) or roi.dtype != np.bool_):
        raise ModelError(f"the region must be bool {[height, width]} as the image, got {roi.dtype} {list(roi.shape)}")
    part = None if roi is None or roi.all() else roi
    geometry = clip_geometry((height, width), preprocessing.size, options.clip_fit)
    kept = None
    if part is not None and options.image_tokens != "all":
        patches = kept_patches(
            part,
            geometry,
            patch_size,
            min_overlap=options.min_patch_overlap,
            ring=options.patch_ring,
        )
        # A language model without any image token answers from the text alone: where CLIP's crop misses the
        # region altogether, it gets the whole crop.
        if patches.any() and not patches.all():
            kept = np.flatnonzero(patches)
    clip_pixels, sam_pixels, sam_hw = scaled(image, geometry, preprocessing, grid.image_size, device)
    return FrameInput(
        (height, width),
        clip_pixels,
        kept,
        sam_pixels,
        sam_hw,
        plan_sam(
            part,
            (height, width),
            grid,
            padding=options.sam_padding,
            windows=options.sam_windows,
            margin=options.sam_margin,
        ),
    )


def scaled(
    image: Image, geometry: ClipGeometry, preprocessing: ClipPreprocessing, sam_side: int, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor, Size]:
    """CLIP's input and SAM's on the device, and the (h, w) of the picture in SAM's."""
    mean, std = preprocessing.mean, preprocessing.std
    if device.type != "cuda":
        sam_pixels, sam_hw = sam_input(image, sam_side)
        return torch.from_numpy(clip_input(image, geometry, mean, std)), torch.from_numpy(sam_pixels), sam_hw
    # A decoder's array may be read-only or turned round, which torch doesn't take.
    frame = torch.from_numpy(np.require(image, requirements=("C", "W"))).to(device)
    return clip_input_on_device(frame, geometry, mean, std), *sam_input_on_device(frame, sam_side)
