"""The steps from a camera frame to its region of interest, each as one labelled picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from cable_codecs import fill_background

from cable_rpc.edge.proposal import RoiProposal, RoiSteps
from cable_rpc.study.annotate import MASK_COLOUR, OUTLINE_COLOUR, TEXT_COLOUR, TRUTH_COLOUR, draw_corners
from cable_rpc.study.sheet_text import Colour, Symbol, put_text, text_width
from cable_rpc.types import BoolMask, Float32Array, Frame, GroundTruth, Image, RoiMask

MOTION_COLOUR: Colour = (70, 150, 255)
DILATION_COLOUR: Colour = (255, 176, 64)
CORRIDOR_COLOUR: Colour = (150, 200, 70)
ENTRY_COLOUR: Colour = (80, 80, 250)
DOUBT_COLOUR: Colour = (225, 165, 235)

PANEL_WIDTH = 480
SHADE = 0.45
"""Brightness of the frame below a map."""
STRENGTH = 0.7
"""Share of the map's colour in what it covers."""

Layer = tuple[BoolMask, Colour]
"""bool [H, W] of the full frame, and the colour it is shown in."""


@dataclass(frozen=True, slots=True)
class ModeView:
    """What one setting of the method made of a frame."""

    title: str
    """E.g. ``paper``."""
    frame: Frame
    proposal: RoiProposal
    """With its steps; without, the panels say that no mask had come yet."""
    answer: BoolMask
    """bool [H, W], the cloud's mask of this frame."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture with what is written above and below it."""

    name: str
    picture: Image
    symbol: Symbol | None = None
    share: float | None = None
    """Of the frame, 0..1."""
    legend: tuple[tuple[str, Colour], ...] = ()


def mode_panels(view: ModeView) -> list[Panel]:
    """The seven pictures from the frame to the upload."""
    frame, proposal = view.frame, view.proposal
    steps = proposal.steps
    maps = step_panels(frame, steps, proposal.staleness or 1) if steps is not None else missing_panels(frame)
    return [frame_panel(view), *maps, upload_panel(frame.image, proposal)]


def frame_panel(view: ModeView) -> Panel:
    """The camera's frame with the cloud's mask, and what the truth has beyond it."""
    frame = view.frame
    picture = shown(frame.image)
    true_mask = instance_union(frame.truth)
    legend = [("cloud's mask of it", MASK_COLOUR)]
    if true_mask is not None:
        outline(picture, true_mask, TRUTH_COLOUR)
        legend.append(("truth beyond it", TRUTH_COLOUR))
    elif frame.truth is not None:
        for box in frame.truth.boxes_xyxy:
            draw_corners(picture, box * (picture.shape[1] / frame.size_hw[1]), 1)
        legend.append(("truth", TRUTH_COLOUR))
    outline(picture, view.answer, MASK_COLOUR)
    return Panel("frame", picture, Symbol("I", "k"), legend=tuple(legend))


def step_panels(frame: Frame, steps: RoiSteps, staleness: int) -> list[Panel]:
    """The five maps, over the darkened frame; the prior is ``staleness`` frames old."""
    then = f"k-{staleness}"
    ground = darkened(frame.image)
    true_mask = instance_union(frame.truth)

    def full(cells: BoolMask) -> BoolMask:
        return RoiMask(cells, steps.scale, *frame.size_hw).pixels()

    prior, motion, dilated = full(steps.warped_prior), full(steps.motion), full(steps.dilated)
    raw, entered, region = full(steps.raw), full(steps.entered), full(steps.region)
    warped = overlay(ground, (prior, MASK_COLOUR))
    prior_legend = [("mask, moved here", MASK_COLOUR)]
    if true_mask is not None:
        outline(warped, true_mask, TRUTH_COLOUR)
        prior_legend.append(("truth", TRUTH_COLOUR))
    raw_legend = [("warped prior", MASK_COLOUR), ("motion within the dilation", MOTION_COLOUR)]
    if (raw & ~prior & ~motion).any():
        raw_legend.append(("cloud unsure", DOUBT_COLOUR))
    layers = [(region, CORRIDOR_COLOUR), (entered, ENTRY_COLOUR), (raw, DILATION_COLOUR)]
    corridor_legend = [("raw ROI", DILATION_COLOUR), ("corridor", CORRIDOR_COLOUR)]
    if entered.any():
        corridor_legend.append(("entry, new view, novelty", ENTRY_COLOUR))
    return [
        Panel("warped prior", warped, Symbol("M", then, accent="^"), share(prior), tuple(prior_legend)),
        Panel(
            "residual motion",
            overlay(ground, (motion, MOTION_COLOUR)),
            Symbol("D", "k"),
            share(motion),
            (("changed beyond the ego-motion", MOTION_COLOUR),),
        ),
        Panel(
            "dilation",
            overlay(ground, (dilated, DILATION_COLOUR), (prior, MASK_COLOUR)),
            Symbol("M", then, "+"),
            share(dilated),
            (("warped prior", MASK_COLOUR), ("its dilation", DILATION_COLOUR)),
        ),
        Panel(
            "raw ROI",
            overlay(ground, (raw, DOUBT_COLOUR), (raw & motion, MOTION_COLOUR), (raw & prior, MASK_COLOUR)),
            Symbol("R", "k", "raw"),
            share(raw),
            tuple(raw_legend),
        ),
        Panel("corridor", overlay(ground, *layers), Symbol("R", "k"), share(region), tuple(corridor_legend)),
    ]


def missing_panels(frame: Frame) -> list[Panel]:
    """The five maps of a frame before the first mask."""
    picture = darkened(frame.image)
    text = "no mask has come yet"
    left = (picture.shape[1] - text_width(text, 18)) // 2
    put_text(picture, text, (left, picture.shape[0] // 2 + 6), 18, TEXT_COLOUR)
    return [
        Panel(name, picture, symbol)
        for name, symbol in (
            ("warped prior", Symbol("M", "k-1", accent="^")),
            ("residual motion", Symbol("D", "k")),
            ("dilation", Symbol("M", "k-1", "+")),
            ("raw ROI", Symbol("R", "k", "raw")),
            ("corridor", Symbol("R", "k")),
        )
    ]


def upload_panel(image: Image, proposal: RoiProposal) -> Panel:
    """What travels: the background blanked, grown to the block grid; keyframes whole."""
    sent = proposal.roi.pixels()
    picture = shown(fill_background(image, sent, "zero"))
    if proposal.keyframe:
        legend: tuple[tuple[str, Colour], ...] = (
            (f"keyframe: whole frame ({proposal.keyframe_reason})", OUTLINE_COLOUR),
        )
        cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), OUTLINE_COLOUR, 3)
    else:
        outline(picture, sent, OUTLINE_COLOUR)
        legend = ((f"sent, on a grid of {proposal.roi.block_size} px", OUTLINE_COLOUR),)
    return Panel("upload", picture, Symbol("I", "k", accent="~"), share(sent), legend)


def shown(image: Image) -> Image:
    """A picture resized to the panel's width, a new uint8 BGR."""
    height, width = image.shape[:2]
    kind = cv2.INTER_AREA if width > PANEL_WIDTH else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, picture_size((height, width)), interpolation=kind), np.uint8)


def picture_size(size_hw: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of a frame's picture on the sheet."""
    return PANEL_WIDTH, max(1, round(size_hw[0] * PANEL_WIDTH / size_hw[1]))


def darkened(image: Image) -> Image:
    """The frame at the panel's size, grey and dark, as the ground of a map."""
    grey = cv2.cvtColor(shown(image), cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.cvtColor(cv2.convertScaleAbs(grey, alpha=SHADE), cv2.COLOR_GRAY2BGR), np.uint8)


def overlay(ground: Image, *layers: Layer) -> Image:
    """A copy of a picture with maps blended over it, each hiding those before it."""
    picture = ground.copy()
    for mask, colour in layers:
        alpha = panel_share(mask)[:, :, None]
        tinted = ground * np.float32(1 - STRENGTH) + np.asarray(colour, np.float32) * np.float32(STRENGTH)
        picture = np.rint(picture * (1 - alpha) + tinted * alpha).astype(np.uint8)
    return picture


def panel_share(mask: BoolMask) -> Float32Array:
    """Strength of a map in each pixel of its panel, float32 0..1."""
    width, height = picture_size(mask.shape)
    kind = cv2.INTER_AREA if mask.shape[1] > width else cv2.INTER_LINEAR
    covered = cv2.resize(mask.astype(np.float32), (width, height), interpolation=kind)
    # Single pixels of a large frame would vanish among their neighbours.
    return np.asarray(np.minimum(2.0 * covered, 1.0), np.float32)


def outline(picture: Image, mask: BoolMask, colour: Colour) -> None:
    """Draw a mask's contours at the panel's size, in place."""
    covered = (panel_share(mask) >= 1.0).astype(np.uint8)
    contours, _ = cv2.findContours(covered, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, 1, cv2.LINE_8)


def instance_union(truth: GroundTruth | None) -> BoolMask | None:
    """The true mask of all annotated objects, bool [H, W]; None where it isn't known."""
    if truth is None or truth.instance_mask is None:
        return None
    return np.asarray(truth.instance_mask > 0, np.bool_)


def share(mask: BoolMask) -> float:
    """Share of a mask that is set, 0..1."""
    return float(np.count_nonzero(mask) / mask.size)
