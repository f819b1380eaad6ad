"""Rows of example frames as one figure of a paper, PNG or PDF."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.annotate import GROUP_COLOURS, MASK_COLOUR, OTHER_COLOUR
from cable_rpc.study.metrics import retained, without_counterpart
from cable_rpc.study.qualitative_figure import FigureRow, SentView, kept_pixels
from cable_rpc.types import CLASS_GROUPS, Detections, Image

SUFFIXES = (".png", ".pdf")
TITLES = {
    "full-frame": "Full frame",
    "motion-only": "Motion only",
    "cable": "CABLE",
    "no-corridor": "Without corridor",
    "open-loop": "Open loop",
    "oracle-boxes": "True boxes",
}
WIDTH_IN = 7.16
"""Text width of IEEE's two-column page."""
GAP_IN, LABEL_IN, RIGHT_IN, CAPTION_IN, TITLE_IN, LEGEND_IN = 0.05, 0.24, 0.01, 0.16, 0.19, 0.22
TEXT_PT, SMALL_PT = 6.5, 5.6
CAPTION_ROOM_IN = 1.3
"""Captions below narrower panels are set smaller."""
PNG_DPI = 400
PICTURE_PX = 1100
"""Pictures wider than this are reduced: more than a panel shows at 800 dpi."""
BADGE_PT_PER_IN, LEAST_BADGE_PT = 14.0, 4.2
"""Lettering inside a picture by the picture's height, up to the text's size."""
OUTSIDE_BGR = (26, 24, 23)
"""Where nothing was sent."""
LOST_RGB = (1.0, 1.0, 1.0)
STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Helvetica", "Arial", "Liberation Sans", "DejaVu Sans"],
    "mathtext.fontset": "dejavusans",
    # Type 42 fonts are embedded whole; publishers refuse the default Type 3.
    "pdf.fonttype": 42,
}


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture of the figure."""

    title: str
    picture: Image
    """uint8 BGR."""
    caption: str
    """Below the picture."""
    badge: str
    """In the picture's corner; empty for none."""
    boxes: Detections
    lost: npt.NDArray[np.float32]
    """float32 [N, 4], whole-frame detections that are not found any more, pixels of the frame."""


def write_figure(rows: Sequence[FigureRow], path: Path) -> None:
    """Draw rows of panels and write them, the whole file or none.

    Columns: original, detections on the whole frame, then for each strategy what it sent with the detections on it,
    and last the region of the last strategy with the cloud's mask.

    Args:
        rows: at least one, all with the same strategies.
        path: ends in ``.png`` or ``.pdf``.

    Raises:
        ConfigurationError: there is no row, the name ends otherwise, or the place can't be written to.
    """
    check_suffix(path)
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rc_context(STYLE):
            draw_figure(rows).savefig(part, format=path.suffix[1:].lower(), dpi=PNG_DPI)
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise ConfigurationError(f"can't write the figure to {path}: {error.strerror or error}") from error


def check_suffix(path: Path) -> None:
    """See that a figure can be written under a name.

    Raises:
        ConfigurationError: it ends neither in ``.png`` nor in ``.pdf``.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{path}': a figure is a PNG or a PDF; give a name that ends in .png or .pdf")


def draw_figure(rows: Sequence[FigureRow]) -> Figure:
    """The figure of at least one row.

    Raises:
        ConfigurationError: there is no row.
    """
    if not rows:
        raise ConfigurationError("a figure needs at least one frame")
    lines = [panels_of(row) for row in rows]
    columns = len(lines[0])
    panel_in = (WIDTH_IN - LABEL_IN - RIGHT_IN - GAP_IN * (columns - 1)) / columns
    heights_in = [panel_in * row.frame.size_hw[0] / row.frame.size_hw[1] for row in rows]
    height_in = TITLE_IN + sum(heights_in) + len(rows) * CAPTION_IN + (len(rows) - 1) * GAP_IN + LEGEND_IN
    figure = Figure(figsize=(WIDTH_IN, height_in))
    top_in = height_in - TITLE_IN
    caption_pt = SMALL_PT * min(1.0, panel_in / CAPTION_ROOM_IN)
    for number, (row, panels, panel_height_in) in enumerate(zip(rows, lines, heights_in, strict=True)):
        middle = (top_in - panel_height_in / 2) / height_in
        figure.text(0.05 / WIDTH_IN, middle, row_label(row, panel_height_in), rotation=90, ha="left", va="center",
                    fontsize=SMALL_PT, linespacing=1.25)  # fmt: skip
        for column, panel in enumerate(panels):
            left_in = LABEL_IN + column * (panel_in + GAP_IN)
            place = (left_in / WIDTH_IN, (top_in - panel_height_in) / height_in)
            axes = figure.add_axes((*place, panel_in / WIDTH_IN, panel_height_in / height_in))
            draw_panel(axes, panel, row.frame.size_hw, max(LEAST_BADGE_PT, BADGE_PT_PER_IN * panel_height_in))
            centre = (left_in + panel_in / 2) / WIDTH_IN
            below = (top_in - panel_height_in - 0.025) / height_in
            figure.text(centre, below, panel.caption, ha="center", va="top", fontsize=caption_pt, color="0.25")
            if number == 0:
                above = (top_in + 0.045) / height_in
                figure.text(centre, above, panel.title, ha="center", va="bottom", fontsize=TEXT_PT, weight="bold")
        top_in -= panel_height_in + CAPTION_IN + GAP_IN
    draw_legend(figure, any(len(panel.lost) for panels in lines for panel in panels))
    return figure


def panels_of(row: FigureRow) -> list[Panel]:
    """The panels of one frame, in their order."""
    nothing = Detections.empty()
    height, width = row.frame.size_hw
    whole = row.whole
    panels = [
        Panel("Original", row.frame.image, f"{width} × {height} px", "", nothing, nothing.boxes_xyxy),
        Panel(TITLES["full-frame"], whole.received, f"{count_text(len(whole.detections))} · {size_text(whole)}", "",
              whole.detections, nothing.boxes_xyxy),
    ]  # fmt: skip
    panels += [strategy_panel(view, whole) for view in row.views]
    if row.views:
        last = row.views[-1]
        caption = f"region {share_text(last)} · mask {100 * last.mask.mean():.1f} %"
        panels.append(Panel("ROI mask", mask_picture(last), caption, "", nothing, nothing.boxes_xyxy))
    return panels


def strategy_panel(view: SentView, whole: SentView) -> Panel:
    """What a strategy sent, with what is found on it and what no longer is."""
    counts = retained(whole.detections, view.detections)
    found = f"{counts.retained}/{counts.reference_count} kept"
    if counts.spurious:
        found += f", {counts.spurious} new"
    return Panel(
        TITLES.get(view.strategy, view.strategy),
        kept_pixels(view, OUTSIDE_BGR),
        f"{found} · {size_text(view)}",
        "keyframe" if view.keyframe else share_text(view),
        view.detections,
        whole.detections.boxes_xyxy[without_counterpart(whole.detections, view.detections)],
    )


def mask_picture(view: SentView) -> Image:
    """The region white on dark, the cloud's mask in its colour inside, uint8 BGR."""
    region = view.region.pixels()
    picture = np.full((*region.shape, 3), 255, np.uint8)
    picture[view.mask] = MASK_COLOUR
    picture[~region] = OUTSIDE_BGR
    return picture


def draw_panel(axes: Axes, panel: Panel, size_hw: tuple[int, int], badge_pt: float) -> None:
    """Show a picture with its boxes and its badge."""
    height, width = size_hw
    picture = panel.picture
    if width > PICTURE_PX:
        size = (PICTURE_PX, max(1, round(height * PICTURE_PX / width)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    axes.imshow(picture[:, :, ::-1], extent=(0, width, height, 0), interpolation="antialiased", aspect="auto")
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.4)
        spine.set_color("0.35")
    if panel.badge:
        draw_badge(axes, panel.badge, min(TEXT_PT, badge_pt))
    for box in panel.lost:
        draw_box(axes, box, LOST_RGB, dashed=True)
    for row in np.argsort(panel.boxes.scores, kind="stable"):
        group = CLASS_GROUPS.get(int(panel.boxes.class_ids[row]), "")
        draw_box(axes, panel.boxes.boxes_xyxy[row], rgb(GROUP_COLOURS.get(group, OTHER_COLOUR)))


def draw_badge(axes: Axes, text: str, size_pt: float) -> None:
    """Write the share into the lower corner, where the road is and little is sent."""
    rim = [withStroke(linewidth=1.6, foreground=rgb(OUTSIDE_BGR))]
    axes.annotate(text, (0, 0), (2.5, 2.5), xycoords="axes fraction", textcoords="offset points", va="bottom",
                  fontsize=size_pt, weight="bold", color="white", path_effects=rim)  # fmt: skip


def draw_box(
    axes: Axes, box: npt.NDArray[np.float32], colour: tuple[float, float, float], *, dashed: bool = False
) -> None:
    """A box whose line has a dark rim, so that it shows on any ground."""
    left, top, right, bottom = box.tolist()
    rim = [withStroke(linewidth=1.5, foreground=(0.0, 0.0, 0.0, 0.55))]
    style = (0, (2.0, 1.2)) if dashed else "solid"
    axes.add_patch(
        Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, linewidth=0.75,
                  linestyle=style, path_effects=None if dashed else rim)
    )  # fmt: skip


def draw_legend(figure: Figure, with_lost: bool) -> None:
    """Say what the colours mean, in one line at the foot."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=rgb(colour), linewidth=1.6, label=group) for group, colour in GROUP_COLOURS.items()
    ]
    if with_lost:
        handles.append(Line2D([], [], color="0.5", linewidth=1.0, linestyle=(0, (2.0, 1.2)), label="no longer found"))
    handles.append(Patch(facecolor=rgb(OUTSIDE_BGR), label="not sent"))
    handles.append(Patch(facecolor="white", edgecolor="0.4", linewidth=0.5, label="region"))
    handles.append(Patch(facecolor=rgb(MASK_COLOUR), label="mask of the cloud"))
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=SMALL_PT, frameon=False,
                  handlelength=1.4, columnspacing=1.6, handletextpad=0.5, borderaxespad=0.2, borderpad=0.1)  # fmt: skip


def row_label(row: FigureRow, height_in: float) -> str:
    """The drive and the frame's number, as far as the row's height has room."""
    # It may reach past the caption's line; letters are half as wide as high.
    room = max(8, int((height_in + CAPTION_IN) / (0.5 * SMALL_PT / 72)))
    name = row.source if len(row.source) <= room else row.source[: room - 1] + "…"
    return f"{name}\nframe {row.frame.index}"


def count_text(count: int) -> str:
    """A number of detections in words."""
    return "1 detection" if count == 1 else f"{count} detections"


def share_text(view: SentView) -> str:
    """The share of the frame that was sent."""
    return f"{100 * view.region.coverage:.1f} %"


def size_text(view: SentView) -> str:
    """The size of the coded frame."""
    return f"{view.packet_bytes / 1e3:.1f} kB"


def rgb(bgr: tuple[int, int, int]) -> tuple[float, float, float]:
    """A colour as matplotlib takes it."""
    blue, green, red = bgr
    return red / 255, green / 255, blue / 255
