"""Which tokens of SAM's image encoder are computed for a frame whose region of interest is known: pure geometry.

SAM sees a square of ``image_size`` pixels, the frame scaled into its top-left corner and zeros right of it or below.
One token is a patch of ``patch_size`` pixels; most blocks attend within windows of ``window`` x ``window`` tokens, and
the windows of the last row and column hang over the token grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cable_models.errors import ModelError
from cable_models.lisa.images import Size, sam_size

SamPadding = Literal["keep", "drop", "always"]
"""What becomes of windows without any picture: computed, not computed on frames with a region, never computed."""
SamWindows = Literal["all", "skip", "tokens"]
"""What becomes of picture outside R_k: computed; windows that miss R_k are skipped; only R_k's tokens are computed."""

BoolGrid = npt.NDArray[np.bool_]
Indexes = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class SamGrid:
    """Sizes of an image encoder that the plan depends on."""

    image_size: int = 1024
    """Side of the square input in pixels."""
    patch_size: int = 16
    """Side of a token in input pixels."""
    window: int = 14
    """Side of an attention window in tokens."""

    def __post_init__(self) -> None:
        if min(self.patch_size, self.window) < 1 or self.image_size < 1 or self.image_size % self.patch_size:
            raise ModelError(
                f"SAM input {self.image_size}, patch {self.patch_size}, window {self.window}: all must be at least 1 "
                "and the input a multiple of the patch"
            )

    @property
    def side(self) -> int:
        """Tokens along one side."""
        return self.image_size // self.patch_size

    @property
    def windows(self) -> int:
        """Windows along one side, the ones that hang over included."""
        return -(-self.side // self.window)


@dataclass(frozen=True, slots=True)
class TokenLayout:
    """The computed tokens of one plan, window by window and row by row inside a window."""

    rows: Indexes
    """int64 [n], token row in the grid."""
    columns: Indexes
    """int64 [n], token column in the grid."""
    slots: Indexes
    """int64 [n], place in the packed windows: number of the window * window ** 2 + place inside it."""
    hidden: BoolGrid
    """bool [w, window ** 2], places inside the grid whose token isn't computed; attention must not see them."""


@dataclass(frozen=True, slots=True)
class SamPlan:
    """Which tokens of one frame are computed."""

    grid: SamGrid
    tokens: BoolGrid
    """bool [side, side], True where computed."""

    @property
    def whole(self) -> bool:
        """Nothing is left out: the unmodified network runs."""
        return bool(self.tokens.all())

    @property
    def token_count(self) -> int:
        """Tokens computed, of ``side ** 2``."""
        return int(np.count_nonzero(self.tokens))

    @property
    def windows(self) -> BoolGrid:
        """bool [windows, windows], True where a window holds any computed token."""
        used: BoolGrid = np.logical_or.reduce(windowed(self.tokens, self.grid), axis=(2, 3))
        return used

    def layout(self) -> TokenLayout:
        """Places of the computed tokens in windows packed without gaps, in the grid's window order."""
        window, side = self.grid.window, self.grid.side
        kept = windowed(self.tokens, self.grid).reshape(-1, window**2)
        inside = windowed(np.ones((side, side), np.bool_), self.grid).reshape(-1, window**2)
        used = np.flatnonzero(kept.any(axis=1))
        number, place = np.nonzero(kept[used])
        return TokenLayout(
            rows=used[number] // self.grid.windows * window + place // window,
            columns=used[number] % self.grid.windows * window + place % window,
            slots=number * window**2 + place,
            hidden=inside[used] & ~kept[used],
        )


def plan_sam(
    roi: BoolGrid | None,
    frame_hw: Size,
    grid: SamGrid,
    *,
    padding: SamPadding = "keep",
    windows: SamWindows = "all",
    margin: int = 0,
) -> SamPlan:
    """Decides which tokens are computed.

    A frame without a region, or whose region is the whole frame, is always computed whole and thereby bit-identical
    to the unmodified network; ``padding="always"`` is the one exception. Attention windows with any picture that
    isn't skipped are computed whole, padding tokens included, so that the blocks before the first global one give
    exactly the unmodified network's numbers. From the first global block on every plan that isn't whole is an
    approximation: what isn't computed isn't attended to either.

    Args:
        roi: bool [H, W], True inside R_k; None stands for the whole frame.
        frame_hw: (H, W) of the frame.
        grid: Sizes of the encoder.
        padding: "drop" leaves out, on frames with a region, the windows that hold no picture; "always" on every
            frame, a stated approximation; "keep" computes them.
        windows: "skip" leaves out windows that R_k doesn't touch, those of padding included. "tokens" computes the
            tokens that R_k touches and no others: fewest operations, and an approximation from the first block on;
            where the sender filled the rest with a constant, what is left out held no picture.
        margin: Tokens by which R_k's tokens are grown, in the picture, before windows or tokens are chosen.

    Raises:
        ModelError: unknown switch, negative margin, or a region whose size or type isn't the frame's.
    """
    if padding not in get_args(SamPadding) or windows not in get_args(SamWindows) or margin < 0:
        raise ModelError(
            f"SAM plan: padding {padding!r} must be one of {get_args(SamPadding)}, windows {windows!r} one of "
            f"{get_args(SamWindows)}, margin {margin} at least 0"
        )
    if roi is not None and (roi.shape != tuple(frame_hw) or roi.dtype != np.bool_):
        raise ModelError(f"region {roi.dtype} {roi.shape} must be bool of the frame's (height, width) {frame_hw}")
    whole = np.ones((grid.side, grid.side), np.bool_)
    picture = picture_tokens(frame_hw, grid)
    if roi is None or roi.all():
        return SamPlan(grid, grow_to_windows(picture, grid) if padding == "always" else whole)
    if windows == "all":
        return SamPlan(grid, whole if padding == "keep" else grow_to_windows(picture, grid))
    wanted = grow(touched_tokens(roi, grid), margin) & picture
    return SamPlan(grid, wanted if windows == "tokens" else grow_to_windows(wanted, grid))


def touched_tokens(roi: BoolGrid, grid: SamGrid) -> BoolGrid:
    """Tokens whose patch holds any part of any pixel of a region.

    Args:
        roi: bool [H, W].
        grid: Sizes of the encoder.

    Returns:
        bool [side, side].
    """
    frame = (roi.shape[0], roi.shape[1])
    height, width = sam_size(frame, grid.image_size)
    bands = [roi[first:last].any(axis=0) for first, last in pixel_spans(frame[0], height, grid)]
    by_row = np.stack(bands)
    tokens = np.zeros((grid.side, grid.side), np.bool_)
    for column, (first, last) in enumerate(pixel_spans(frame[1], width, grid)):
        tokens[: len(bands), column] = by_row[:, first:last].any(axis=1)
    return tokens


def pixel_spans(length: int, scaled: int, grid: SamGrid) -> list[tuple[int, int]]:
    """Frame pixels (first, last + 1) that lie, even in part, under each token along one axis; padding tokens have none.

    Args:
        length: Frame pixels along the axis.
        scaled: Length of the frame in SAM's input.
        grid: Sizes of the encoder.
    """
    starts = range(0, scaled, grid.patch_size)
    ends = (min(start + grid.patch_size, scaled) for start in starts)
    return [(start * length // scaled, -(-end * length // scaled)) for start, end in zip(starts, ends, strict=True)]


def picture_tokens(frame_hw: Size, grid: SamGrid) -> BoolGrid:
    """bool [side, side], True where a token holds any picture, False where it holds only padding."""
    height, width = sam_size(frame_hw, grid.image_size)
    tokens = np.zeros((grid.side, grid.side), np.bool_)
    tokens[: -(-height // grid.patch_size), : -(-width // grid.patch_size)] = True
    return tokens


def grow(tokens: BoolGrid, margin: int) -> BoolGrid:
    """Every token within ``margin`` rows and columns of a marked one."""
    grown = tokens
    for _ in range(margin):
        framed = np.pad(grown, 1)
        tall = framed[:-2] | framed[1:-1] | framed[2:]
        grown = tall[:, :-2] | tall[:, 1:-1] | tall[:, 2:]
    return grown


def grow_to_windows(tokens: BoolGrid, grid: SamGrid) -> BoolGrid:
    """Every token of every window that holds a marked one."""
    used = windowed(tokens, grid).any(axis=(2, 3))
    return used.repeat(grid.window, axis=0).repeat(grid.window, axis=1)[: grid.side, : grid.side]


def windowed(tokens: BoolGrid, grid: SamGrid) -> BoolGrid:
    """A token grid cut into windows: bool [windows, windows, window, window], False where they hang over."""
    excess = grid.windows * grid.window - grid.side
    padded = np.pad(tokens, ((0, excess), (0, excess)))
    shape = (grid.windows, grid.window, grid.windows, grid.window)
    return padded.reshape(shape).swapaxes(1, 2)
