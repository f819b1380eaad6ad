"""The tables as text: figures from metrics, the paper's beside them, LaTeX that is whole, CSV that can be read."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer import Typer
from typer.testing import CliRunner

from cable_rpc.cli.tables import tables
from cable_rpc.study.sequence_metrics import (
    AP_FIGURES,
    FIGURES,
    ByteLayers,
    MaskOverlap,
    MeasuredFrame,
    SequenceMetrics,
    measure_sequence,
)
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.draw_csv import draw_csv
from cable_rpc.study.tables.draw_latex import draw_latex
from cable_rpc.study.tables.equal_quality import EQUAL_QUALITY_FIGURES
from cable_rpc.study.tables.paper_values import CROSS_DATA_SET, STRATEGIES
from cable_rpc.study.tables.report import TableReport
from cable_rpc.study.tables.settings import RunSettings, SequenceRequest
from cable_rpc.study.tables.table_columns import ACROSS_DATA_SETS, ACROSS_STRATEGIES, SPECIAL_FIGURES
from cable_rpc.types import Detections, GroundTruth

SHARED = Path(__file__).resolve().parents[3] / "shared"
NAMES = ("cable", "full-frame")


def detections(*boxes: tuple[float, float, float, float]) -> Detections:
    count = len(boxes)
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 4), np.full(count, 2, np.int32), np.full(count, 0.9, np.float32)
    )


def sequence(coverages: list[float], *, keep: int, name: str) -> SequenceMetrics:
    """Frames with two true cars each, of which the first ``keep`` frames' regions lose the second one."""
    cars = ((0.0, 0.0, 40.0, 40.0), (60.0, 0.0, 100.0, 40.0))
    truth = GroundTruth(
        np.array(cars, np.float32), np.full(2, 2, np.int32), np.arange(2, dtype=np.int32), np.ones(2, np.float32)
    )
    frames = [
        MeasuredFrame(
            index=index,
            keyframe=index == 0,
            coverage_roi=coverage,
            coverage_tx=coverage,
            staleness=1,
            truth=truth,
            detections=detections(*(cars if index >= keep else cars[:1])),
            full_detections=detections(*cars),
            overlap_roi=np.array([1.0, 0.3]),
            overlap_sent=np.array([1.0, 1.0 if index == 0 else 0.3]),
            mask_overlap=MaskOverlap(50, 100),
            bytes_up=ByteLayers(250, 300, 400, 500),
            bytes_down=ByteLayers(10, 10, 20, 40),
            full_bytes_up=ByteLayers(1000, 1000, 1000, 1000),
            stage_ns={"roi": 1_000_000},
            end_to_end_ns=2_000_000 * (index + 1),
        )
        for index, coverage in enumerate(coverages)
    ]
    return measure_sequence(frames, name=name, fps=10.0)


def report(*datasets: str, by_frame: bool, count: int = 3, **changes: Any) -> TableReport:
    cells = [
        Cell(
            SequenceRequest(dataset, f"{dataset}:root#{number}"),
            strategy,
            f"{dataset}-{number}",
            sequence([1.0, 0.2, 0.4], keep=2, name=str(number)),
            detector="tiles (1, cpu)",
            segmenter="boxes (1, cpu)",
        )
        for dataset in datasets
        for number in range(count)
        for strategy in NAMES
    ]
    return TableReport([*cells, *changes.pop("more", [])], NAMES, RunSettings(), by_frame=by_frame, **changes)


def printed(found: TableReport) -> str:
    console = Console(width=120, file=io.StringIO(), force_terminal=False)
    console.print(found.draw(), highlight=False)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def csv_rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_every_column_is_filled_by_a_figure_that_exists() -> None:
    known = {*FIGURES, *AP_FIGURES, *SPECIAL_FIGURES, *EQUAL_QUALITY_FIGURES}
    for _, measures in (*ACROSS_DATA_SETS, *ACROSS_STRATEGIES):
        for measure in measures:
            assert measure.pooled in known
            assert measure.by_frame in {*known, ""}


def test_figures_of_a_row_by_hand() -> None:
    """R_k covers 0.2 and 0.4 of the frames after the first; sent are 1, 0.2, 0.4 of the three frames.

    One of the two cars is found in the first two frames, both in the last.
    """
    paper, headline = (rows_of(report("kitti", by_frame=by_frame))[0] for by_frame in (True, False))
    assert float(paper["coverage"]) == pytest.approx(0.3)
    assert float(headline["coverage"]) == pytest.approx(1.6 / 3)
    assert float(paper["pixel_saving"]) == pytest.approx(0.7)
    speedups = [(350 / (94 + 256 * coverage)) ** 2 for coverage in (0.2, 0.4)]
    assert float(paper["prefill_quadratic"]) == pytest.approx(np.mean(speedups))
    assert float(headline["prefill_quadratic"]) == pytest.approx((350 / (94 + 256 * 1.6 / 3)) ** 2)
    assert float(paper["recognition_05"]) == 1.0
    assert float(paper["recognition_50"]) == pytest.approx(0.5)
    assert float(headline["recognition_50"]) == pytest.approx(4 / 6)
    assert float(headline["roi_recall"]) == pytest.approx(4 / 6)
    assert float(paper["roi_f1"]) == pytest.approx((2 / 3 + 2 / 3 + 1) / 3)
    assert float(headline["full_f1"]) == 1.0
    assert float(headline["byte_saving_bitstream"]) == pytest.approx(0.75)
    assert float(headline["byte_saving_transport"]) == pytest.approx(0.5)
    assert float(headline["up_kbps"]) == pytest.approx(400 * 8 * 10 / 1e3)
    assert float(headline["mask_iou"]) == 0.5
    assert float(headline["latency_p50_ms"]) == pytest.approx(4.0)
    assert float(headline["keyframe_rate"]) == pytest.approx(1 / 3)
    assert headline["prefill_measured"] == headline["token_reduction_model"] == ""
    # Three equal sequences: the bootstrap can't spread.
    assert float(headline["coverage_low"]) == pytest.approx(float(headline["coverage_high"]))


def rows_of(found: TableReport, place: int = 0) -> list[dict[str, str]]:
    return csv_rows(draw_csv(found.tables[place]))


def test_the_papers_rows_stand_below_ours_and_the_average_last() -> None:
    rows = rows_of(report("kitti", "synthetic", "nuscenes", by_frame=True))
    assert [row["row"] for row in rows] == [
        "nuScenes", "nuScenes (paper)", "KITTI", "KITTI (paper)", "rendered", "average", "average (paper)",
    ]  # fmt: skip
    assert [row["source"] for row in rows] == ["ours", "paper"] * 2 + ["ours"] * 2 + ["paper"]
    strategies = rows_of(report("nuscenes", by_frame=True), 1)
    assert [row["row"] for row in strategies] == ["cable", "cable (paper)", "full-frame"]
    elsewhere = rows_of(report("kitti", by_frame=True), 1)
    assert [(row["block"], row["row"]) for row in elsewhere] == [
        ("KITTI", "cable"), ("KITTI", "full-frame"), ("nuScenes (paper)", "cable"),
    ]  # fmt: skip


def test_the_papers_values_are_those_of_its_reading() -> None:
    reading = SHARED / "reference" / "paper.md"
    if not reading.exists():
        pytest.skip("needs the reading of the paper, reference/paper.md in ../shared")
    found = {}
    for line in reading.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) in (7, 12) and re.fullmatch(r"\d+\.\d", cells[1]):
            found[cells[0]] = [float(cell) for cell in cells[1:]]
    names = {
        "nuScenes": "nuscenes",
        "WOD-ZB": "wod_zb",
        "Waymo": "waymo",
        "KITTI": "kitti",
        "CADC": "cadc",
        "Average": "average",
    }
    strategies = {
        "Motion-only": "motion-only",
        "Open-loop LLM": "open-loop",
        "CABLE": "cable",
        "w/o corridor": "no-corridor",
    }
    assert set(found) == {*names, *strategies}
    percent = {"coverage", "pixel_saving", "token_reduction", "recognition_05", "retention"}
    for title, figures in found.items():
        ours = CROSS_DATA_SET[names[title]] if title in names else STRATEGIES[strategies[title]]
        assert [value * (100 if key in percent else 1) for key, value in ours.items()] == pytest.approx(figures)


@pytest.mark.parametrize("by_frame", [True, False])
def test_latex_is_whole(by_frame: bool) -> None:
    texts = [draw_latex(table) for table in report("nuscenes", "kitti", by_frame=by_frame).tables]
    for whole in texts:
        text = "\n".join(line for line in whole.splitlines() if not line.startswith("%"))
        assert text.count("{") == text.count("}")
        begun = re.findall(r"\\begin\{([a-z*]+)\}", text)
        assert sorted(begun) == sorted(re.findall(r"\\end\{([a-z*]+)\}", text))
        tabulars = re.findall(r"\\begin\{tabular\}\{(l r*|lr+)\}(.*?)\\end\{tabular\}", text, re.S)
        assert len(tabulars) == begun.count("tabular") == 3
        for columns, body in tabulars:
            for rule in (r"\toprule", r"\bottomrule"):
                assert body.count(rule) == 1
            assert body.count(r"\midrule") >= 1
            for row in re.findall(r"^(.*) \\\\$", body, re.M):
                spanned = sum(int(number) - 1 for number in re.findall(r"\\multicolumn\{(\d+)\}", row))
                assert len(re.findall(r"(?<!\\)&", row)) + 1 + spanned == len(columns)
        assert not re.search(r"(?<!\\)[%#_$](?!-\$|\\times)", re.sub(r"\$[^$]*\$|\\label\{[^}]*\}", "", text))
    assert r"\textit{23.7}" in texts[0]


def test_terminal_and_markdown_show_the_same_figures_within_120_columns() -> None:
    found = report("kitti", "nuscenes", by_frame=True, count=2, workers=2, command_line="cable-rpc tables ...")
    terminal, markdown = printed(found), found.markdown()
    assert max(len(line) for line in terminal.splitlines()) <= 120
    for text in ("26.4", "73.6", "88.6", ".59", "30.0", "70.0", "97.1"):
        assert text in terminal
        assert text in markdown
    assert "95 % intervals" not in terminal
    assert "Fewer than 3 sequences of nuScenes, KITTI" in terminal.replace("\n", " ")
    assert "`cable-rpc tables ...`" in markdown
    for block in re.findall(r"(?:^\|.*\|$\n?)+", markdown, re.M):
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_failures_and_damage_are_told() -> None:
    request = SequenceRequest("kitti", "kitti:root#9")
    more = [
        Cell(request, name, "kitti-9", error="image 3 is missing", skipped=("0003.png: cut short",)) for name in NAMES
    ]
    found = report("kitti", by_frame=False, more=more)
    for text in (printed(found), found.markdown()):
        assert "kitti-9 (cable, full-frame): image 3 is missing" in text
        assert text.count("0003.png: cut short") == 1
    assert len(found.failed) == 2
    nothing = TableReport(more, NAMES, RunSettings())
    assert "image 3 is missing" in printed(nothing)
    assert nothing.texts() == {}


def test_the_command_measures_prints_writes_and_tells_of_failure(tmp_path: Path) -> None:
    app = Typer()
    app.command()(tables)
    options = {
        "max-frames": "2",
        "size": "160x96",
        "segmenter": "boxes",
        "strategies": "cable,full-frame",
    }
    arguments = [word for key, value in options.items() for word in (f"--{key}", value)]
    arguments += ["--data", "synthetic:11", "--workers", "1", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "Table I." in done.output
    assert "Table II." in done.output
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"cells", "tables.md", "figures.csv", "table1.tex", "table1.csv", "table2.tex", "table2.csv"}
    rows = csv_rows((tmp_path / "figures.csv").read_text())
    assert {row["figure"] for row in rows} == {*FIGURES, *AP_FIGURES, *EQUAL_QUALITY_FIGURES}
    failed = CliRunner().invoke(app, [*arguments, "--data", "video:nowhere.mp4"], catch_exceptions=False)
    assert failed.exit_code == 1
    assert "nowhere.mp4" in failed.output
    assert len(list((tmp_path / "cells").iterdir())) == 4
