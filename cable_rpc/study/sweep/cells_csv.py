"""A sweep's cells as a flat table, a row each."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from typing import Any

from cable_rpc.study.sequence_metrics import pool
from cable_rpc.study.sweep.cell import CellResult, MeasuredCell, SweepCell
from cable_rpc.study.sweep.qualities import QUALITIES

FIGURES = ("coverage_tx", "keyframe_rate", "spurious_rate", "roi_precision_visible", "roi_recall_visible")
"""Named figures of `cable_rpc.study.sequence_metrics` that stand beside the qualities, as shares."""


def cells_csv(cells: Iterable[MeasuredCell]) -> str:
    """CSV text with a header; qualities in their units, sizes in bytes, empty where there is no value."""
    rows = [axes(one.cell) | {"key": one.key} | measured_values(one) for one in cells]
    header = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO()
    table = csv.DictWriter(text, list(header), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def axes(cell: SweepCell) -> dict[str, Any]:
    """Where the cell lies in the grid."""
    width, height = cell.clip.size or ("", "")
    return {
        "source": cell.clip.source,
        "strategy": cell.strategy,
        "treatment": cell.treatment_label,
        "codec": cell.codec,
        "quality": cell.rate.quality,
        "bitrate_kbps": cell.rate.bitrate_kbps,
        "fps": cell.clip.fps,
        "width": width,
        "height": height,
        "scale": cell.treatment.scale,
        "feedback_delay": cell.feedback_delay,
        "link": "" if cell.link is None else cell.link.name,
        "roi": cell.roi_label,
        "method": cell.method,
        "setting": cell.setting,
    }


def measured_values(measured: MeasuredCell) -> dict[str, Any]:
    """What came out, empty where it failed, and why."""
    return {"error": measured.error} | ({} if measured.result is None else result_values(measured.result))


def result_values(result: CellResult) -> dict[str, Any]:
    """Sizes, qualities and figures of a cell."""
    pooled = pool([result.metrics])
    latency = pooled.end_to_end_ms()
    return {
        "sequence": result.sequence,
        "sent_width": result.size_wh[0],
        "sent_height": result.size_wh[1],
        "frames": result.metrics.frames,
        "dropped": result.dropped,
        "seconds": result.seconds,
        "truth": result.truth,
        "uplink_bytes": result.uplink.total,
        "uplink_kbps": result.uplink.total * 8 / 1000 / result.seconds,
        "keyframe_picture_bytes": result.uplink.keyframe_pictures,
        "region_picture_bytes": result.uplink.region_pictures,
        "side_information_bytes": result.uplink.side_information,
        "message_overhead_bytes": result.uplink.message_overhead,
        **{name: quality.value(result) for name, quality in QUALITIES.items()},
        **{name: pooled.figure(name).value for name in FIGURES},
        "end_to_end_ms_p50": None if latency is None else latency.p50,
        "end_to_end_ms_p95": None if latency is None else latency.p95,
        "detector": result.detector,
        "segmenter": result.segmenter,
    }
