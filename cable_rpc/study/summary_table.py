"""The closing tables of a run in the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from cable_rpc.study.language_table import PREFILL_COLUMNS, language_rows, prefill_rows
from cable_rpc.study.metrics import Scores
from cable_rpc.study.summary import LayerBytes, Quality, RunSummary, StageLatency, honesty_notes

LAYER_LABELS = {
    "bitstream": "coded picture · mask",
    "with_roi": "+ ROI side information",
    "message": "whole message",
    "transport": "transport",
}
NOT_MEASURED = "–"
TABLE_WIDTH = 98


def render_summary(summary: RunSummary) -> RenderableType:
    """Compact tables (bytes, latency, quality, language model) and the notes, for a terminal of 100 columns."""
    return Group(
        headline(summary),
        Text(),
        bytes_table(summary),
        latency_table(summary),
        quality_table(summary),
        *language_tables(summary),
        *(Text(f"· {note}", style="dim") for note in honesty_notes(summary)),
    )


def headline(summary: RunSummary) -> Text:
    """One or two lines: what became of the frames, and the two savings side by side."""
    frames = summary.frames
    text = Text()
    text.append(f"{frames.captured} frames", style="bold")
    text.append(f"  {frames.answered} answered", style="green")
    for count, word in ((frames.dropped, "dropped"), (frames.rejected, "rejected"), (frames.lost, "lost")):
        text.append(f" · {count} {word}", style="yellow" if count else "dim")
    saving = summary.layer("message").byte_saving
    text.append("\nbytes saved ", style="bold")
    if saving is None:
        text.append("not measured (no full-frame pass)", style="dim")
    else:
        text.append(percent(saving), style="bold green" if saving > 0 else "bold red")
    text.append("   pixels saved ", style="bold")
    text.append(percent(summary.pixel_saving))
    text.append(
        f"   (ROI {percent(summary.coverage_roi)} of the frame, sent {percent(summary.coverage_tx)}, "
        f"keyframes {percent(summary.keyframe_rate)})",
        style="dim",
    )
    return text


def new_table(title: str) -> Table:
    """An empty table in the house style."""
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        header_style="dim",
        pad_edge=False,
        width=TABLE_WIDTH,
    )


def bytes_table(summary: RunSummary) -> Table:
    """Bytes per frame and kbit/s at each layer, both ways, beside the full frame."""
    table = new_table("Bytes per frame sent")
    table.add_column("counted at", no_wrap=True)
    for name in ("uplink", "kbit/s", "downlink", "kbit/s", "full frame", "saving"):
        table.add_column(name, justify="right", no_wrap=True)
    for layer in summary.layers:
        table.add_row(
            layer_label(layer, summary.info.transport_source),
            whole(layer.uplink_bytes_per_frame),
            whole(layer.uplink_kbps),
            whole(layer.downlink_bytes_per_frame),
            whole(layer.downlink_kbps),
            whole(layer.full_frame_bytes_per_frame),
            saving_text(layer.byte_saving),
            style="bold" if layer.layer == "message" else "",
        )
    return table


def latency_table(summary: RunSummary) -> Table:
    """Percentiles of each stage, the largest medians shown by a bar."""
    table = new_table("Latency, ms")
    table.add_column("stage", no_wrap=True)
    for name in ("mean", "p50", "p95", "p99", "frames"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("p50", no_wrap=True)
    whole_way = summary.stage("end_to_end")
    longest = whole_way.p50_ms if whole_way else max((stage.p50_ms for stage in summary.latency), default=0.0)
    for stage in summary.latency:
        bold = stage.stage == "end_to_end"
        length = round(24 * min(1.0, stage.p50_ms / longest)) if longest > 0 else 0
        table.add_row(
            stage.label,
            *(f"{value:.1f}" for value in (stage.mean_ms, stage.p50_ms, stage.p95_ms, stage.p99_ms)),
            str(stage.frames),
            Text("━" * length, style="cyan" if bold else "blue"),
            style="bold" if bold else ("dim" if stage.stage in ("capture", "server") or is_part(stage) else ""),
        )
    return table


def is_part(stage: StageLatency) -> bool:
    """Whether its time is contained in that of another stage."""
    return stage.label.startswith("·")


def quality_table(summary: RunSummary) -> Table:
    """Freshness, recognition, detection and mask figures, those that the run has."""
    table = new_table("Quality")
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("of what")
    for name, value, remark in quality_rows(summary):
        table.add_row(name, value, Text(remark, style="dim"))
    return table


def language_tables(summary: RunSummary) -> list[Table]:
    """Tokens, and the prefill's three columns; nothing for a segmenter without a language model."""
    if summary.language is None:
        return []
    tokens = new_table("Language model")
    tokens.add_column("figure", no_wrap=True)
    tokens.add_column("value", justify="right", no_wrap=True)
    tokens.add_column("of what")
    for name, value, remark in language_rows(summary.language):
        tokens.add_row(name, value, Text(remark, style="dim"))
    rows = prefill_rows(summary)
    if not rows:
        return [tokens]
    prefill = new_table("Prefill speed-up")
    for name in PREFILL_COLUMNS[:-1]:
        prefill.add_column(name, justify="left" if name == PREFILL_COLUMNS[0] else "right", no_wrap=True)
    prefill.add_column(PREFILL_COLUMNS[-1])
    for *cells, remark in rows:
        prefill.add_row(*cells, Text(remark, style="dim"))
    return [tokens, prefill]


def quality_rows(summary: RunSummary) -> list[tuple[str, str, str]]:
    """(name, value, what it is of) of each quality figure; shared by the terminal and the report."""
    quality = summary.quality
    rows = [
        (
            "staleness",
            f"{number(summary.staleness_mean_frames, 2)} / {number(summary.staleness_max_frames, 0)}",
            "mean / largest age of the mask behind each ROI, in frames",
        )
    ]
    rows += truth_rows(quality)
    if quality.retention is not None:
        rows.append(("detection retention", percent(quality.retention), "of full-frame detections, pooled"))
        rows.append(("spurious", percent(quality.spurious_rate), "of ROI-only detections, absent on full frames"))
    if quality.roi_psnr_db is not None:
        rows.append(("PSNR in the ROI", f"{quality.roi_psnr_db:.1f} dB", "luma, decoded against camera"))
    if quality.mask_confidence is not None:
        rows.append(("mask confidence", number(quality.mask_confidence, 2), "mean, as the segmenter states it"))
    return rows


def truth_rows(quality: Quality) -> list[tuple[str, str, str]]:
    """The figures that need ground truth, or one row that says there is none."""
    if quality.truth_frames == 0:
        return [("recognition, recall", NOT_MEASURED, "no truth in this source")]
    objects = f"{quality.truth_count} objects on {quality.truth_frames} frames"
    rows = [
        (
            f"recognition at {threshold:.0%}",
            percent(value),
            f"of {objects}" if threshold < 0.1 else f"with {threshold:.0%} of the box inside the ROI",
        )
        for threshold, value in quality.recognition
    ]
    if quality.micro is not None:
        rows.append(
            (
                "precision / recall / F1",
                scores(quality.micro),
                f"pooled over {quality.scored_frames} frames, IoU 0.5, merged classes",
            )
        )
    if quality.macro_frame is not None:
        rows.append(("the same, averaged by frame", scores(quality.macro_frame), "as the paper averages"))
    return rows


def layer_label(layer: LayerBytes, transport_source: str) -> str:
    """The layer's name; transport says where its figure is from."""
    label = LAYER_LABELS[layer.layer]
    return f"{label} ({transport_source})" if layer.layer == "transport" else label


def saving_text(saving: float | None) -> Text:
    """A byte saving, red where it is a loss."""
    if saving is None:
        return Text(NOT_MEASURED, style="dim")
    return Text(percent(saving), style="green" if saving > 0 else "red")


def scores(values: Scores) -> str:
    """Precision, recall and F1 in percent."""
    return " / ".join(percent(value) for value in (values.precision, values.recall, values.f1))


def percent(value: float | None) -> str:
    """A share as percent with one decimal."""
    return NOT_MEASURED if value is None else f"{100.0 * value:.1f} %"


def whole(value: float | None) -> str:
    """A number rounded to whole units, thousands set apart."""
    return NOT_MEASURED if value is None else f"{value:,.0f}".replace(",", " ")


def number(value: float | None, decimals: int) -> str:
    """A number with the given decimals."""
    return NOT_MEASURED if value is None else f"{value:.{decimals}f}"
