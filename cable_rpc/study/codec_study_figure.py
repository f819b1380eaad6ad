"""The curves and BD-rates of a codec study as one interactive page that needs no network."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.codec_compare import ANCHOR_CODEC, MEASURES, ClipView, StudyResults, Way
from cable_rpc.study.codec_study_tables import clips_line
from cable_rpc.study.report_plots import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED
from cable_rpc.study.study_treatments import WHOLE

FIGURE_FILE = "codec_study.html"
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, RED, "#7db4e0", "#c3a5dd", "#8cc9a8", "#f0be85", "#5b7794", "#b08d57", GREY)
PLOT_PX, GAP_PX, HEAD_PX = 380, 105, 170
"""Height of one plot with its gap, the gap between plots, and the room for title and legend."""
RATE_TICKS = [scale * digit for scale in (1, 10, 100, 1000, 10_000, 100_000) for digit in (1, 2, 5)]
DASHES = ("solid", "dot", "dash", "dashdot", "longdash")


def write_figure(results: StudyResults, path: Path) -> None:
    """Write the page.

    Raises:
        ConfigurationError: The file can't be written.
    """
    figure = study_figure(results)
    try:
        path.write_text(figure.to_html(include_plotlyjs=True, full_html=True), encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"can't write {path}: {error.strerror or error}") from error


def study_figure(results: StudyResults) -> go.Figure:
    """Rate against in-region PSNR for each clip, and below them the BD-rates."""
    measure = MEASURES["roi_psnr"]
    views, ways = results.views, results.ways
    count = len(views)
    titles = [view_title(results, view) for view in views] + ["<b>BD-rate against whole frames in H.264, %</b>"]
    height = PLOT_PX * (count + 1) + HEAD_PX
    figure = make_subplots(count + 1, 1, subplot_titles=titles, vertical_spacing=GAP_PX / (height - HEAD_PX))
    for way, (colour, dash) in styles(ways).items():
        label = f"{way.treatment} · {way.codec}"
        for row, view in enumerate(views, 1):
            points = [point for point in results.of(view, way) if measure.of(point) is not None]
            points.sort(key=lambda point: point.kbps)
            hover = [
                f"{label} {point.quality}<br>{point.kbps:.0f} kbit/s, "
                f"of it {100 * point.mask_bytes / point.total_bytes:.1f} % masks<br>"
                f"{point.roi_psnr_db:.2f} dB, SSIM {point.roi_ssim:.4f}"
                for point in points
            ]
            figure.add_scatter(
                x=[point.kbps for point in points],
                y=[measure.of(point) for point in points],
                name=label,
                legendgroup=label,
                showlegend=row == 1,
                mode="lines+markers",
                line={"color": colour, "dash": dash, "width": 3 if way == Way(WHOLE, ANCHOR_CODEC) else 1.8},
                marker={"size": 6},
                text=hover,
                hoverinfo="text",
                row=row,
                col=1,
            )
        deltas = [results.compare(view, way, measure) for view in views]
        figure.add_bar(
            x=[f"{view.title}, {view.kind}" for view in views],
            y=[None if one is None else one.bd_rate for one in deltas],
            name=label,
            legendgroup=label,
            showlegend=False,
            marker={"color": colour},
            row=count + 1,
            col=1,
        )
    for row in range(1, count + 1):
        figure.update_xaxes(
            type="log", title="kbit/s, masks included", tickvals=RATE_TICKS, tickformat="d", row=row, col=1
        )
        figure.update_yaxes(title="dB inside the region", row=row, col=1)
    # Titles stand above the left end of their plots, where no width cuts them.
    figure.update_annotations(x=0, xanchor="left", align="left", font={"size": 13})
    figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"t": HEAD_PX, "l": 60, "r": 20, "b": 60},
        font={"color": INK, "family": "system-ui, sans-serif"},
        title={
            "text": "Codec study: bytes against quality inside the region",
            "y": 1,
            "yref": "container",
            "pad": {"t": 16},
        },
        legend={"orientation": "h", "y": 1 - 46 / height, "yref": "container", "yanchor": "top"},
    )
    return figure


def view_title(results: StudyResults, view: ClipView) -> str:
    """A clip's file, and what its regions are, in two short lines."""
    line = clips_line(results, view).removeprefix(f"{view.clip}: ")
    return f"<b>{view.title}, region {view.kind}</b><br>{line}"


def styles(ways: list[Way]) -> dict[Way, tuple[str, str]]:
    """Colour by treatment, dashes by codec; the anchor is black."""
    colours = dict(zip(dict.fromkeys(way.treatment for way in ways if way.treatment != WHOLE), cycle(COLOURS)))
    dashes = dict(zip(dict.fromkeys(way.codec for way in ways), cycle(DASHES)))
    return {way: (colours.get(way.treatment, "#111111"), dashes[way.codec]) for way in ways}
