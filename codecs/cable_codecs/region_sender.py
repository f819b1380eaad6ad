"""The edge's side of a treatment: from the tracker's region and the camera's picture to what is encoded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cable_codecs.base import BoolMask, Image
from cable_codecs.crop import CropBox, crop
from cable_codecs.errors import CodecError
from cable_codecs.feather import feather_edge
from cable_codecs.fill import fill_blocks
from cable_codecs.hysteresis import RegionHysteresis
from cable_codecs.region_grid import check_blocks, grow_to_grid, region_pixels
from cable_codecs.treatment import RegionGeometry, RegionTreatment
from cable_codecs.upload_scale import reduce_image


@dataclass(frozen=True, slots=True)
class TreatedFrame:
    """A picture to encode, and what must travel with it."""

    image: Image
    """uint8 [height, width, 3], BGR; valid until the next frame is treated."""
    blocks: BoolMask | None
    """bool [rows, columns] over the full picture, the region that is sent; None: the whole frame."""
    block_size: int
    """Side of these blocks in pixels of the full picture."""
    crop: CropBox | None
    """What ``image`` is of the uploaded picture, None: all. Follows from ``blocks``, so it need not travel."""
    uploaded_blocks: BoolMask | None
    """bool, the region on the uploaded picture before cropping."""
    uploaded_block_size: int
    """Side of these in uploaded pixels."""
    uploaded_size: tuple[int, int]
    """(height, width) of the uploaded picture before cropping."""

    def encoder_roi(self) -> BoolMask | None:
        """bool [height, width] of ``image``, True inside the region; None: all of it."""
        if self.uploaded_blocks is None:
            return None
        pixels = region_pixels(self.uploaded_blocks, self.uploaded_block_size, *self.uploaded_size)
        return pixels if self.crop is None else np.ascontiguousarray(pixels[self.crop.slices])


class RegionSender:
    """Treats the frames of one stream before they are encoded. Not safe for use by several threads at once."""

    def __init__(self, treatment: RegionTreatment, height: int, width: int) -> None:
        """Prepare for frames of one size.

        Raises:
            CodecError: A side below 1 pixel.
        """
        self.treatment = treatment
        self.geometry = RegionGeometry(treatment, height, width)
        self.hysteresis = RegionHysteresis(treatment.hold_frames, most_share=treatment.hold_most_share)
        self.canvas = np.zeros((*self.geometry.uploaded, 3), np.uint8)

    def treat(
        self, image: Image, blocks: BoolMask | None, block_size: int = 1, *, keyframe: bool = False
    ) -> TreatedFrame:
        """Treat the next frame.

        Args:
            image: uint8 [height, width, 3], BGR; left unchanged.
            blocks: bool [ceil(height / block_size), ceil(width / block_size)], what the tracker wants sent; None: the
                whole frame.
            block_size: Side of a block in pixels.
            keyframe: The encoder will start afresh here: a frozen background begins with black.

        Raises:
            CodecError: Arrays that don't fit.
        """
        geometry, treatment = self.geometry, self.treatment
        if image.dtype != np.uint8 or image.shape != (*geometry.size, 3):
            raise CodecError(f"the image must be uint8 {[*geometry.size, 3]}, got {image.dtype} {list(image.shape)}")
        if blocks is None:
            return self.whole(image)
        check_blocks(blocks, block_size, *geometry.size)
        # A region in blocks of a multiple of the grid lies on it already.
        if block_size % treatment.grid:
            blocks, block_size = grow_to_grid(blocks, block_size, treatment.grid, *geometry.size), treatment.grid
        blocks = self.hysteresis.update(blocks)
        uploaded_blocks, uploaded_block_size = geometry.on_upload(blocks, block_size)
        box = geometry.box(uploaded_blocks, uploaded_block_size)
        picture = self.filled(self.at_upload_resolution(image), uploaded_blocks, uploaded_block_size, keyframe)
        return TreatedFrame(
            picture if box is None else crop(picture, box),
            blocks,
            block_size,
            box,
            uploaded_blocks,
            uploaded_block_size,
            geometry.uploaded,
        )

    def whole(self, image: Image) -> TreatedFrame:
        """A frame that is sent whole: only its resolution changes."""
        self.hysteresis.reset()
        picture = self.at_upload_resolution(image)
        if self.treatment.fill == "freeze":
            np.copyto(self.canvas, picture)
        grid = self.treatment.grid
        return TreatedFrame(picture, None, grid, None, None, grid, self.geometry.uploaded)

    def at_upload_resolution(self, image: Image) -> Image:
        """The image as large as it is sent; the argument itself at scale 1."""
        return image if self.treatment.scale == 1 else reduce_image(image, self.geometry.uploaded)

    def filled(self, image: Image, blocks: BoolMask, block_size: int, keyframe: bool) -> Image:
        """The image with its background filled and its edge feathered."""
        treatment = self.treatment
        if treatment.fill == "keep":
            return image
        if treatment.fill == "freeze" and keyframe:
            self.canvas.fill(0)
        fill_blocks(image, blocks, block_size, treatment.fill, out=self.canvas)
        if treatment.feather_px:
            roi = region_pixels(blocks, block_size, *self.geometry.uploaded)
            feather_edge(image, self.canvas, roi, treatment.feather_px)
        return self.canvas
