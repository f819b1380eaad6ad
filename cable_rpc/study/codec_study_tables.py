"""A codec study in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from cable_rpc.study.codec_compare import (
    MEASURES,
    ClipView,
    Comparison,
    Measure,
    StudyResults,
    Way,
    mean_and_worst,
)
from cable_rpc.study.study_treatments import WHOLE
from cable_rpc.study.summary_table import new_table

NOTHING = "–"


def render_study(results: StudyResults) -> RenderableType:
    """BD-rates, bytes at equal setting and milliseconds for each kind of region, and how to read them."""
    return Group(
        *(table for kind, part in results.by_kind().items() for table in kind_tables(part, kind)),
        Text("· bytes are coded pictures and coded masks; each BD-rate is against whole frames in H.264", style="dim"),
        Text("· bytes saved at the same setting don't compare quality, the BD-rate does", style="dim"),
        Text("· milliseconds were taken beside other processes of the study", style="dim"),
        *(Text(f"· no BD-rate for {refusal}", style="dim") for refusal in refusals(results)),
    )


def kind_tables(results: StudyResults, kind: str) -> list[Table]:
    """The tables of one kind of region."""
    measures = [measure for measure in MEASURES.values() if has_any(results, measure)]
    return [*(bd_table(results, measure, kind) for measure in measures), cost_table(results, kind)]


def refusals(results: StudyResults) -> list[str]:
    """Where there is no BD-rate by PSNR, and why."""
    measure = MEASURES["roi_psnr"]
    return sorted(
        f"{way.treatment} {way.codec} on {view.title}, {view.kind}: {one.refusal}"
        for view in results.views
        for way in results.ways
        if (one := results.compare(view, way, measure)) is not None and one.refusal
    )


def has_any(results: StudyResults, measure: Measure) -> bool:
    """Whether some treatment has a BD-rate by this quality."""
    compared = (
        results.compare(view, way, measure) for view in results.views for way in results.ways if way.treatment != WHOLE
    )
    return any(one is not None and one.bd_rate is not None for one in compared)


def bd_table(results: StudyResults, measure: Measure, kind: str) -> Table:
    """A row for each way, a column for each clip, best mean first."""
    views = [
        view for view in results.views if any(results.compare(view, way, measure) is not None for way in results.ways)
    ]
    table = new_table(f"Region {kind}: BD-rate in % against whole frames in H.264, by {measure.title}")
    table.width = None
    table.add_column("treatment", no_wrap=True)
    table.add_column("codec", no_wrap=True)
    for view in views:
        table.add_column(view.title.replace("/", "\n"), justify="right")
    table.add_column("mean", justify="right")
    table.add_column("worst", justify="right")
    table.add_column("least\noverlap", justify="right")
    rows = [(way, [results.compare(view, way, measure) for view in views]) for way in results.ways]
    for way, comparisons in sorted(rows, key=sort_key):
        mean, worst = mean_and_worst(comparisons)
        overlaps = [one.overlap for one in comparisons if one is not None and one.overlap is not None]
        table.add_row(
            way.treatment,
            way.codec,
            *(percent(None if one is None else one.bd_rate) for one in comparisons),
            percent(mean),
            percent(worst),
            f"{min(overlaps):.2f}" if overlaps else NOTHING,
            style="dim" if way.treatment == WHOLE else "",
        )
    return table


def sort_key(row: tuple[Way, Sequence[Comparison | None]]) -> tuple[bool, float]:
    """Rows with a mean by it, the others behind."""
    mean, _ = mean_and_worst(row[1])
    return mean is None, 0.0 if mean is None else mean


def cost_table(results: StudyResults, kind: str) -> Table:
    """Bytes saved at the same setting beside pixels, mask bytes, and times; means over clips and qualities."""
    table = new_table(f"Region {kind}: cost, means over clips and qualities")
    table.width = None
    table.add_column("treatment", no_wrap=True)
    table.add_column("codec", no_wrap=True)
    for name in ("pixels\nsaved %", "bytes\nsaved %", "mask\nB/frame", "mask\n% of bytes", "treat\nms", "encode\nms",
                 "decode\nms", "restore\nms", "whole\nframe dB"):  # fmt: skip
        table.add_column(name, justify="right")
    for way in results.ways:
        savings = [saving for view in results.views if (saving := results.byte_saving(view, way)) is not None]
        table.add_row(
            way.treatment,
            way.codec,
            f"{100 * (1 - results.mean(way, lambda point: point.coverage_sent)):.1f}",
            f"{100 * sum(savings) / len(savings):.1f}" if savings else NOTHING,
            f"{results.mean(way, lambda point: point.mask_bytes / point.frames):.0f}",
            f"{100 * results.mean(way, lambda point: point.mask_bytes / point.total_bytes):.1f}",
            f"{results.mean(way, lambda point: point.treat_ms):.1f}",
            f"{results.mean(way, lambda point: point.encode_ms):.1f}",
            f"{results.mean(way, lambda point: point.decode_ms):.1f}",
            f"{results.mean(way, lambda point: point.restore_ms):.1f}",
            f"{results.mean(way, lambda point: point.frame_psnr_db):.1f}",
        )
    return table


def percent(value: float | None) -> str:
    """One digit after the point, with its sign."""
    return NOTHING if value is None else f"{value:+.1f}"


def clips_line(results: StudyResults, view: ClipView) -> str:
    """What was studied of a clip."""
    point = next(point for (seen, _), points in results.points.items() if seen == view for point in points)
    kind, _, cloud = view.mask.partition(", ")
    region = f"{kind} by {Path(cloud).name}" if cloud else kind
    return (
        f"{view.clip}: {point.frames} frames of {point.width}x{point.height} at {point.fps:g} fps, region {region}, "
        f"{100 * point.coverage:.1f} % of the picture, {point.whole_frames} of the frames sent whole"
    )
