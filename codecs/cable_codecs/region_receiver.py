"""The cloud's side of a treatment: from the decoded picture and its region to what the models see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask, Image
from cable_codecs.compose import BackgroundComposer, ComposedFrame
from cable_codecs.crop import CropBox, uncrop
from cable_codecs.diffuse import diffuse_background
from cable_codecs.errors import CodecError
from cable_codecs.fill import GREY, background_colour, copy_kept, paint
from cable_codecs.region_grid import check_blocks, grow_to_grid, region_pixels
from cable_codecs.treatment import RegionGeometry, RegionTreatment
from cable_codecs.upload_scale import enlarge_image


@dataclass(frozen=True, slots=True)
class RestoredFrame:
    """A decoded picture at full size again."""

    image: Image
    """uint8 [height, width, 3], BGR."""
    roi: BoolMask | None
    """bool [height, width], where the image shows this frame; None: everywhere."""
    composed: ComposedFrame | None
    """The same image with the age of every block, where the treatment composes."""


class RegionReceiver:
    """Undoes on decoded pictures what a `RegionSender` of the same treatment did; frames may be missing.

    Not safe for use by several threads at once.
    """

    def __init__(self, treatment: RegionTreatment, height: int, width: int) -> None:
        """Prepare for frames of one size.

        Raises:
            CodecError: A side below 1 pixel.
        """
        self.treatment = treatment
        self.geometry = RegionGeometry(treatment, height, width)
        self.composer = BackgroundComposer(height, width, treatment.grid) if treatment.compose else None

    def crop_of(self, blocks: BoolMask | None, block_size: int) -> CropBox | None:
        """The crop that a region stands for, None: the whole uploaded picture; says what size to decode.

        Raises:
            CodecError: The region doesn't belong to the pictures.
        """
        if blocks is None:
            return None
        self.check_region(blocks, block_size)
        return self.geometry.box(*self.geometry.on_upload(blocks, block_size))

    def restore(
        self, picture: Image, blocks: BoolMask | None, block_size: int = 1, *, stamp: int | None = None
    ) -> RestoredFrame:
        """Undo the treatment of a frame.

        Args:
            picture: uint8 [height, width, 3], BGR, as decoded, of the size that was sent.
            blocks: bool [rows, columns] over the full picture, the region that travelled; None: a whole frame.
            block_size: Side of a block in pixels.
            stamp: Frame number or time, for the ages of what is composed.

        Raises:
            CodecError: The picture hasn't the size that the region stands for, or the region lies off the grid.
        """
        geometry = self.geometry
        box = self.crop_of(blocks, block_size)
        expected = geometry.uploaded if box is None else (box.height, box.width)
        if picture.dtype != np.uint8 or picture.shape != (*expected, 3):
            raise CodecError(
                f"the decoded picture must be uint8 {[*expected, 3]} for its region, got {picture.dtype} "
                f"{list(picture.shape)}; do both ends have the same treatment?"
            )
        colour = np.zeros(3, np.uint8) if blocks is None else self.fill_colour(picture, blocks, block_size, box)
        roi = None if blocks is None else region_pixels(blocks, block_size, *geometry.size)
        refill = roi is not None and self.treatment.refills and self.composer is None
        diffuse = refill and self.treatment.refill == "diffuse"
        if box is not None and (self.treatment.scale < 1 or not refill or diffuse):
            picture, box = uncrop(picture, box, *geometry.uploaded, colour), None
        if self.treatment.scale < 1:
            picture = enlarge_image(picture, geometry.size, self.treatment.interpolation)
        if self.composer is not None:
            grid = self.treatment.grid
            renewed = None if blocks is None else grow_to_grid(blocks, block_size, grid, *geometry.size)
            composed = self.composer.compose(picture, renewed, stamp=stamp)
            return RestoredFrame(composed.image, roi, composed)
        if roi is None or not refill:
            return RestoredFrame(picture, roi, None)
        if diffuse:
            return RestoredFrame(diffuse_background(picture, roi), roi, None)
        image = np.empty((*geometry.size, 3), np.uint8)
        paint(image, colour)
        # A crop that is to be refilled anyway goes straight to its place.
        place = (slice(None), slice(None)) if box is None else box.slices
        copy_kept(picture, roi.view(np.uint8)[place], image[place])
        return RestoredFrame(image, roi, None)

    def check_region(self, blocks: BoolMask, block_size: int) -> None:
        """Check a region that travelled.

        Raises:
            CodecError: It doesn't belong to the pictures, or lies off the grid.
        """
        check_blocks(blocks, block_size, *self.geometry.size)
        if block_size % self.treatment.grid:
            raise CodecError(
                f"the region comes in blocks of {block_size} px, off the treatment's grid of {self.treatment.grid} px; "
                "do both ends have the same treatment?"
            )

    def fill_colour(
        self, picture: Image, blocks: BoolMask, block_size: int, box: CropBox | None
    ) -> npt.NDArray[np.uint8]:
        """uint8 [3], what the background gets: for ``mean`` the mean of what was decoded outside the region."""
        if self.treatment.fill == "grey":
            return np.full(3, GREY, np.uint8)
        if self.treatment.fill != "mean":
            return np.zeros(3, np.uint8)
        uploaded_blocks, uploaded_block_size = self.geometry.on_upload(blocks, block_size)
        keep = region_pixels(uploaded_blocks, uploaded_block_size, *self.geometry.uploaded)
        inside = keep if box is None else np.ascontiguousarray(keep[box.slices])
        return background_colour(picture, inside.view(np.uint8))
