"""How a region is treated between the tracker's mask and the encoder, and what the receiver undoes.

The sender, in this order: grow the region to the grid; hold blocks that just left it; lower the resolution; fill the
background; feather the edge; crop. The receiver, from the decoded picture and the region that travelled with it:
put the crop back in place; enlarge; fill the background again, since lossy coding smears it and models take its edges
for objects; compose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, get_args

from cable_codecs.base import BoolMask
from cable_codecs.crop import CropBox, CropMode, check_crop_mode, crop_box
from cable_codecs.errors import CodecError
from cable_codecs.feather import check_feather
from cable_codecs.fill import FillMode, check_fill_mode
from cable_codecs.hysteresis import check_hysteresis
from cable_codecs.quantiser_offset import check_offset
from cable_codecs.size_offset import check_size_offset
from cable_codecs.upload_scale import (
    Interpolation,
    check_scale,
    uploaded_region,
    uploaded_size,
)

LARGEST_GRID = 64

RefillMode = Literal["constant", "diffuse"]
"""What the receiver puts outside the region. ``constant``: the colour that the fill stands for, black for most.
``diffuse``: the region's own colours, spread outward (`cable_codecs.diffuse_background`)."""


@dataclass(frozen=True, slots=True)
class RegionTreatment:
    """Every switch, each independent of the others; the defaults are those of a video codec.

    Raises:
        CodecError: A value is outside its range, or two contradict each other.
    """

    fill: FillMode = "zero"
    """What stands outside the region."""
    grid: int = 8
    """Side in pixels of the blocks to which the region is grown, 1..64; 1 leaves it as it comes."""
    hold_frames: int = 0
    """Frames for which a block stays in the region after it left."""
    hold_most_share: float = 1.0
    """Share of the picture beyond which no blocks are held."""
    feather_px: int = 0
    """Width of the gradual edge outside the region, 0..64."""
    crop: CropMode = "none"
    """Whether only the rows, or the box, around the region are sent; stateless image codecs only."""
    scale: float = 1.0
    """Sides of the picture sent, as a share of the camera's, 1/16..1."""
    interpolation: Interpolation = "cubic"
    """How the receiver enlarges."""
    refill: RefillMode = "constant"
    """What the receiver puts there before the models look; nothing where the fill is ``keep`` or it composes."""
    compose: bool = False
    """Whether the receiver puts the last background back."""
    quantiser_offset: float = 0.0
    """Coarser quantisation outside the region, 0..1 as a share of the quantiser scale; needs an encoder that heeds it
    (`quantiser_offset.require_offsets`), and makes most sense with ``fill="keep"``."""
    size_offset: float = 0.0
    """How much coarser each connected piece of the region is quantised for each doubling of its size, 0..0.5, up to
    ``quantiser_offset``: large objects are found at a coarse quantiser too (`cable_codecs.size_offset`)."""

    def __post_init__(self) -> None:
        check_fill_mode(self.fill)
        if self.refill not in get_args(RefillMode):
            raise CodecError(f"unknown refill {self.refill!r}; choose one of {', '.join(get_args(RefillMode))}")
        if not 1 <= self.grid <= LARGEST_GRID:
            raise CodecError(f"the region's grid must be 1..{LARGEST_GRID} pixels, got {self.grid}")
        check_hysteresis(self.hold_frames, self.hold_most_share)
        check_feather(self.feather_px)
        check_crop_mode(self.crop)
        check_scale(self.scale, self.interpolation)
        check_offset(self.quantiser_offset)
        check_size_offset(self.size_offset, self.quantiser_offset)
        if self.feather_px and self.fill in ("freeze", "keep"):
            raise CodecError(
                f"a feathered edge fades into a fill, but {self.fill!r} has none of its own; use feather_px=0"
            )
        if self.crop != "none" and self.fill == "freeze":
            raise CodecError("a frozen background lies outside the crop; choose another fill or crop='none'")

    @classmethod
    def default_for(cls, *, stateless: bool) -> Self:
        """What measured best: a frozen background for video, rows cropped to the region for image codecs; and for the
        models the region's own colours around it."""
        return cls(crop="rows", refill="diffuse") if stateless else cls(fill="freeze", refill="diffuse")

    @property
    def refills(self) -> bool:
        """True where the receiver fills the background again, which lossy coding smears and freezing leaves stale."""
        return self.fill != "keep"

    def check_codec(self, name: str, *, stateless: bool) -> None:
        """Check that a codec can carry pictures treated so.

        Args:
            name: Of the codec, for the error text.
            stateless: True for image codecs, each frame of which stands alone.

        Raises:
            CodecError: It can't.
        """
        if self.crop != "none" and not stateless:
            raise CodecError(
                f"{name} pictures can't change their size from frame to frame; use crop='none' or an image codec"
            )
        if self.fill == "freeze" and stateless:
            raise CodecError(
                f"a frozen background costs {name} its bytes in every frame, since none refers to another; "
                "choose another fill or a video codec"
            )
        if self.quantiser_offset > 0 and stateless:
            raise CodecError(f"{name} has no quantiser offsets; use quantiser_offset=0 or a video codec")


class RegionGeometry:
    """What sender and receiver both derive from a region."""

    def __init__(self, treatment: RegionTreatment, height: int, width: int) -> None:
        if min(height, width) < 1:
            raise CodecError(f"pictures must have positive sides, got {width}x{height}")
        self.treatment = treatment
        self.size = (height, width)
        self.uploaded = uploaded_size(height, width, treatment.scale)

    def on_upload(self, blocks: BoolMask, block_size: int) -> tuple[BoolMask, int]:
        """The region on the uploaded picture and its block size."""
        if self.treatment.scale == 1:
            return blocks, block_size
        grid = self.treatment.grid
        return uploaded_region(blocks, block_size, self.size, self.uploaded, grid, self.treatment.interpolation), grid

    def box(self, uploaded_blocks: BoolMask, block_size: int) -> CropBox | None:
        """The crop of the uploaded picture, None where nothing is cut."""
        treatment = self.treatment
        if treatment.crop == "none":
            return None
        return crop_box(uploaded_blocks, block_size, *self.uploaded, treatment.crop, margin_px=treatment.feather_px)
