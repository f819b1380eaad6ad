"""Tokens and prefill of a run, by hand; and that its three columns only ever show together."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cable_rpc.study.language_record import language_columns, segment_parts, whole_prefill
from cable_rpc.study.language_table import prefill_rows
from cable_rpc.study.run_record import FrameRecord, RunInfo, read_frames, write_frames
from cable_rpc.study.summary import summarise, write_summary
from cable_rpc.study.summary_table import render_summary
from cable_rpc.types import PrefillCost, Segmentation

INFO = RunInfo("clip", 640, 480, 10.0, "h264", "CRF 28", "cable", "robust", segmenter="lisa:tiny")
MASK = np.zeros((4, 6), np.bool_)
PREFILL = PrefillCost(100, 9.0, 3.0, 20_000_000, 40_000_000)


def record(index: int, **changes: object) -> FrameRecord:
    told = language_columns(Segmentation(MASK, 1.0, 0, 200, prefill=PREFILL, decoding="forced"))
    base = FrameRecord(index, index * 10**8, "answered", uplink_message_bytes=1000, segment_ns=30_000_000, **told)
    return replace(base, **changes)  # type: ignore[arg-type]


# 100 tokens of 300, and a keyframe with all 300.
RECORDS = [
    record(0, tokens_in=200, prefill_quadratic=1.0, prefill_flops=1.0, prefill_ns=40_000_000, decoding="generate"),
    record(1),
    record(2, outcome="rejected"),
    FrameRecord(3, 3 * 10**8, "dropped"),
]


def shown(records: list[FrameRecord]) -> str:
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(render_summary(summarise(records, INFO)))
    return console.export_text()


def test_columns_of_a_frame() -> None:
    columns = language_columns(
        Segmentation(MASK, 1.0, 60, 256, prefill=PrefillCost(94, 5.2, 2.3, 7), decoding="forced")
    )
    assert columns == {
        "tokens_in": 60,
        "tokens_full": 256,
        "decoding": "forced",
        "prompt_tokens": 94,
        "prefill_quadratic": 5.2,
        "prefill_flops": 2.3,
        "prefill_ns": 7,
        "prefill_whole_ns": None,
    }
    assert language_columns(Segmentation(MASK, 1.0)) == language_columns(None) == {}
    assert segment_parts({"clip": 3, "unheard_of": 4})["segment_clip_ns"] == 3
    assert set(segment_parts({}).values()) == {None}


def test_the_whole_frame_s_own_prefill_takes_precedence() -> None:
    whole = Segmentation(MASK, 1.0, 256, 256, prefill=PrefillCost(94, 1.0, 1.0, 99, 80))
    assert whole_prefill(whole) == {"prefill_whole_ns": 99}
    untimed = replace(whole, prefill=PrefillCost(94, 1.0, 1.0, 0, 80))
    assert whole_prefill(untimed) == whole_prefill(Segmentation(MASK, 1.0)) == whole_prefill(None) == {}


def test_columns_survive_the_file(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    write_frames(path, RECORDS)
    assert read_frames(path) == RECORDS


def test_tokens_and_speedups_by_hand() -> None:
    cost = summarise(RECORDS, INFO).language
    assert cost is not None
    assert (cost.frames, cost.tokens_in, cost.tokens_full, cost.prompt_tokens) == (2, 100, 200, 100)
    assert cost.visual_reduction == pytest.approx(0.5)
    assert cost.token_reduction == pytest.approx(1 - (300 + 100) / 600)
    assert cost.decodings == (("generate", 1), ("forced", 1))
    assert cost.of_run is not None
    # work by n^2: 2 * 300^2 for the whole frames, 300^2 + 100^2 as it was; by operations a third of one frame's
    assert cost.of_run.quadratic == pytest.approx(2 * 300**2 / (300**2 + 100**2))
    assert cost.of_run.flops == pytest.approx(2 / (1 + 1 / 3))
    assert cost.of_run.measured == pytest.approx(80 / 60)
    assert cost.of_frames is not None
    assert (cost.of_frames.quadratic, cost.of_frames.flops) == (5.0, 2.0)
    assert cost.of_frames.measured == pytest.approx((1 + 2) / 2)
    assert (cost.prefill_ms, cost.whole_prefill_ms, cost.timed_frames) == (30.0, 40.0, 2)


def test_all_three_columns_are_shown_together() -> None:
    text = shown(RECORDS)
    row = next(line for line in text.splitlines() if line.lstrip().startswith("whole run"))
    assert "1.80 ×" in row
    assert "1.50 ×" in row
    assert "1.33 ×" in row
    header = next(line for line in text.splitlines() if "operations" in line)
    assert "paper's estimate" in header
    assert "measured" in header
    assert "the server had seen" in " ".join(text.split())
    assert "generate: 1; forced: 1" in text
    assert max(map(len, text.splitlines())) <= 100


def test_an_untimed_whole_frame_leaves_its_column_empty_but_there() -> None:
    rows = prefill_rows(summarise([replace(entry, prefill_whole_ns=None) for entry in RECORDS], INFO))
    assert [row[1:4] for row in rows] == [("1.80 ×", "1.50 ×", "–"), ("5.00 ×", "2.00 ×", "–")]


def test_tokens_without_prefill_show_no_speedup() -> None:
    bare = dict.fromkeys(("prompt_tokens", "prefill_quadratic", "prefill_flops", "prefill_ns"))
    text = shown([replace(entry, prefill_whole_ns=None, **bare) for entry in RECORDS])
    assert "100.0 of 200" in text
    assert "×" not in text
    assert "Prefill" not in text


def test_a_segmenter_without_tokens_shows_nothing() -> None:
    records = [FrameRecord(0, 0, "answered", uplink_message_bytes=10)]
    assert summarise(records, INFO).language is None
    text = shown(records)
    assert "token" not in text.lower()
    assert "prefill" not in text.lower()


def test_parts_of_the_segmenter_s_time_stand_after_it() -> None:
    records = [replace(entry, segment_clip_ns=2_000_000, segment_prefill_ns=20_000_000) for entry in RECORDS]
    stages = [stage.stage for stage in summarise(records, INFO).latency]
    assert stages == ["segment", "segment_clip", "segment_prefill"]


def test_the_report_has_the_same_tables_and_a_plot(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    from cable_rpc.study.report import write_report

    for folder, records in ((tmp_path / "with", RECORDS), (tmp_path / "without", [FrameRecord(0, 0, "answered")])):
        folder.mkdir()
        write_frames(folder / "frames.csv", records)
        write_summary(folder, summarise(records, INFO))
    page = write_report(tmp_path / "with").read_text()
    for part in ("Language model", "1.80 / 1.50 / 1.33", "<td>1.33 ×</td>", 'Plotly.newPlot("plot-prefill"'):
        assert part in page
    stored = json.loads((tmp_path / "with" / "summary.json").read_text())["summary"]["language"]
    assert stored["of_run"]["measured"] == pytest.approx(4 / 3)
    bare = write_report(tmp_path / "without").read_text()
    assert "Language model" not in bare
    assert "plot-prefill" not in bare
