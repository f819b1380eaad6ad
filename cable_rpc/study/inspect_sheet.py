"""One frame's way to its region of interest as a sheet of labelled pictures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from cable_rpc.edge.proposal import RoiProposal
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.annotate import OUTLINE_COLOUR, STRIP_COLOUR, TEXT_COLOUR
from cable_rpc.study.inspect_panels import PANEL_WIDTH, ModeView, Panel, instance_union, mode_panels, picture_size
from cable_rpc.study.metrics import mask_iou
from cable_rpc.study.sheet_text import BOLD, Colour, Symbol, fit_text, put_symbol, put_text, text_width
from cable_rpc.types import Frame, Image, RoiMask

MUTED_COLOUR: Colour = (168, 162, 158)
BORDER_COLOUR: Colour = (78, 72, 68)
STAGE_COLOURS: tuple[Colour, ...] = (
    (200, 170, 120),
    (210, 60, 190),
    (70, 150, 255),
    (255, 176, 64),
    (150, 200, 70),
    (80, 80, 250),
    (170, 170, 170),
)
"""Of the parts of the timing bar, one after another."""

COLUMNS = 4
GAP = 20
CAPTION_HEIGHT = 34
LEGEND_HEIGHT = 28
HEADER_HEIGHT = 78
TITLE_HEIGHT = 50
MIN_PICTURE_HEIGHT = 250
"""So much the figures need."""
TEXT_PX = 16
VALUE_COLUMN = 205
"""x of the values in the figures panel."""


def draw_sheet(views: Sequence[ModeView], title: str, subtitle: str) -> Image:
    """Draw the steps of one frame, a block of 4 x 2 panels for each setting of the method.

    Args:
        views: one for each block, all of frames of one size.
        title: first line of the sheet.
        subtitle: second line, smaller.

    Returns:
        uint8 BGR, 2020 pixels wide.

    Raises:
        ConfigurationError: there is no view, or their frames differ in size.
    """
    if not views or len({view.frame.size_hw for view in views}) != 1:
        sizes = [view.frame.size_hw for view in views]
        raise ConfigurationError(f"a sheet shows one frame in one size; got views of {sizes}")
    width = COLUMNS * PANEL_WIDTH + (COLUMNS + 1) * GAP
    header = blank(HEADER_HEIGHT, width)
    put_text(header, fit_text(title, width - 2 * GAP, 28, BOLD), (GAP, 44), 28, TEXT_COLOUR, BOLD)
    put_text(header, fit_text(subtitle, width - 2 * GAP, 17), (GAP, 70), 17, MUTED_COLOUR)
    return np.concatenate([header, *(draw_view(view, width) for view in views)], axis=0)


def draw_view(view: ModeView, width: int) -> Image:
    """A title line and the panels of one setting, uint8 BGR of the given width."""
    picture_height = picture_size(view.frame.size_hw)[1]
    # The figures stand in the second row, which a panorama's pictures would leave too low for them.
    figures_height = max(MIN_PICTURE_HEIGHT, picture_height)
    around = CAPTION_HEIGHT + LEGEND_HEIGHT + 8
    tops = (TITLE_HEIGHT, TITLE_HEIGHT + picture_height + around)
    panels = mode_panels(view)
    canvas = blank(tops[1] + figures_height + around + GAP // 2, width)
    cv2.line(canvas, (GAP, 4), (width - GAP, 4), BORDER_COLOUR, 1)
    end = put_text(canvas, view.title, (GAP, 36), 22, OUTLINE_COLOUR, BOLD)
    put_text(canvas, summary_line(view.proposal), (end + 16, 36), 17, MUTED_COLOUR)
    for number, panel in enumerate([*panels, Panel("figures", figures(view, figures_height))]):
        row, column = divmod(number, COLUMNS)
        place(canvas, panel, GAP + column * (PANEL_WIDTH + GAP), tops[row])
    return canvas


def place(canvas: Image, panel: Panel, left: int, top: int) -> None:
    """Put a panel with its caption and legend onto the sheet, in place."""
    baseline = top + CAPTION_HEIGHT - 10
    end = put_text(canvas, panel.name, (left, baseline), 18, TEXT_COLOUR, BOLD)
    if panel.symbol is not None:
        put_symbol(canvas, panel.symbol, (end + 10, baseline), 19, MUTED_COLOUR)
    if panel.share is not None:
        text = percent(panel.share)
        put_text(canvas, text, (left + PANEL_WIDTH - text_width(text, 17), baseline), 17, TEXT_COLOUR)
    height, width = panel.picture.shape[:2]
    upper, start = top + CAPTION_HEIGHT, left + (PANEL_WIDTH - width) // 2
    canvas[upper : upper + height, start : start + width] = panel.picture
    cv2.rectangle(canvas, (start - 1, upper - 1), (start + width, upper + height), BORDER_COLOUR, 1)
    x, baseline = left, upper + height + 20
    for text, colour in panel.legend:
        cv2.rectangle(canvas, (x, baseline - 11), (x + 11, baseline), colour, cv2.FILLED)
        x = put_text(canvas, text, (x + 18, baseline), 15, MUTED_COLOUR) + 20


def figures(view: ModeView, height: int) -> Image:
    """The numbers of one frame as a panel, uint8 BGR [height, PANEL_WIDTH, 3]."""
    canvas = blank(height, PANEL_WIDTH)
    rows = figure_rows(view)
    pitch = min(24, (height - 78) // len(rows))
    for number, (label, symbol, value) in enumerate(rows):
        baseline = 22 + number * pitch
        end = put_text(canvas, label, (12, baseline), TEXT_PX, MUTED_COLOUR)
        if symbol is not None:
            put_symbol(canvas, symbol, (end + 8, baseline), TEXT_PX, MUTED_COLOUR)
        value = fit_text(value, PANEL_WIDTH - VALUE_COLUMN - 10, TEXT_PX)
        put_text(canvas, value, (VALUE_COLUMN, baseline), TEXT_PX, TEXT_COLOUR)
    draw_timings(canvas, view.proposal, height - 62)
    return canvas


def figure_rows(view: ModeView) -> list[tuple[str, Symbol | None, str]]:
    """Names, symbols and values of the figures."""
    proposal = view.proposal
    iou = prior_iou(view.frame, proposal)
    return [
        ("corridor", Symbol("R", "k"), percent(proposal.coverage)),
        ("raw ROI", Symbol("R", "k", "raw"), percent(proposal.raw_coverage)),
        ("sent", None, percent(proposal.roi.coverage)),
        ("keyframe", Symbol("c", "k"), keyframe_text(proposal)),
        ("prior", None, prior_text(proposal)),
        ("IoU of prior and truth", None, "not known" if iou is None else f"{iou:.2f}"),
        ("ego-motion model", None, proposal.ego_model or "none yet"),
        ("horizontal shift", None, f"{proposal.shift_px:+.1f} px".replace("-", "\N{MINUS SIGN}")),
        ("dilation radius", Symbol("b", "k"), f"{proposal.dilation_px:.1f} px"),
    ]


def draw_timings(canvas: Image, proposal: RoiProposal, top: int) -> None:
    """The ROI stages as parts of one bar with their milliseconds, in place."""
    stages = [(name, ns / 1e6) for name, ns in proposal.timings.stages_ns.items()]
    total = sum(ms for _, ms in stages)
    if total <= 0:
        return
    room = PANEL_WIDTH - 24
    x = put_text(canvas, f"ROI {total:.1f} ms", (12, top + 12), TEXT_PX, TEXT_COLOUR, BOLD) + 12
    start, done = x, 0.0
    for (_, ms), colour in zip(stages, STAGE_COLOURS, strict=False):
        left, right = (start + round((12 + room - start) * part / total) for part in (done, done + ms))
        cv2.rectangle(canvas, (left, top), (max(left, right - 1), top + 12), colour, cv2.FILLED)
        done += ms
    for number, ((name, ms), colour) in enumerate(zip(stages, STAGE_COLOURS, strict=False)):
        row, column = divmod(number, COLUMNS)
        x, baseline = 12 + column * room // COLUMNS, top + 34 + 20 * row
        cv2.rectangle(canvas, (x, baseline - 9), (x + 8, baseline - 1), colour, cv2.FILLED)
        put_text(canvas, f"{name} {ms:.2f}", (x + 13, baseline), 14, MUTED_COLOUR)


def prior_iou(frame: Frame, proposal: RoiProposal) -> float | None:
    """Agreement of the warped prior with the frame's true mask on the analysis grid; None where either is unknown."""
    true_mask, steps = instance_union(frame.truth), proposal.steps
    if true_mask is None or steps is None:
        return None
    return mask_iou(steps.warped_prior, RoiMask.from_pixels(true_mask, steps.scale).blocks)


def blank(height: int, width: int) -> Image:
    """An empty part of the sheet."""
    return np.full((height, width, 3), STRIP_COLOUR, np.uint8)


def percent(part: float) -> str:
    """0.1234 as "12.3 %"."""
    return f"{100 * part:.1f} %"


def prior_text(proposal: RoiProposal) -> str:
    """Which mask was the prior, and how old it is."""
    if proposal.prior_index is None or proposal.staleness is None:
        return "none yet"
    age = "1 frame old" if proposal.staleness == 1 else f"{proposal.staleness} frames old"
    return f"mask of frame {proposal.prior_index}, {age}"


def keyframe_text(proposal: RoiProposal) -> str:
    """Whether the frame is sent whole, and why."""
    return f"yes: {proposal.keyframe_reason}" if proposal.keyframe else "no"


def summary_line(proposal: RoiProposal) -> str:
    """The outcome in a few words."""
    if not proposal.keyframe:
        return f"{percent(proposal.roi.coverage)} of the pixels are sent"
    whole = f"keyframe ({proposal.keyframe_reason}): the whole frame is sent"
    return whole if proposal.steps is None else f"{whole}, its corridor is {percent(proposal.coverage)}"
