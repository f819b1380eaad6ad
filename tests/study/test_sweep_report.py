from __future__ import annotations

import csv
import html
import re
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import pytest
from fabricated_sweep import ANCHOR, CRFS, KEPT, SEQUENCES, cell_of, method_cells, result_of, sweep_run
from typer.testing import CliRunner

from cable_rpc.cli.app import app
from cable_rpc.cli.report import report
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.run_record import FrameRecord, RunInfo, write_frames
from cable_rpc.study.summary import summarise, write_summary
from cable_rpc.study.sweep.cell import MeasuredCell, RatePoint
from cable_rpc.study.sweep.cell_settings import CellLabels
from cable_rpc.study.sweep.run_folder import RunFile, SweepRun
from cable_rpc.study.sweep.simulated_link import SimulatedLink
from cable_rpc.study.sweep.store import CellStore
from cable_rpc.study.sweep_report.examples import MOST_PICTURES, example_rows
from cable_rpc.study.sweep_report.facts import byte_savings, facts_of
from cable_rpc.study.sweep_report.methods import (
    ShortNames,
    anchors_of,
    at_any_scale,
    cells_by_method,
    is_repeated,
    method_styles,
    short_names,
)

pytest.importorskip("plotly")

from cable_rpc.study.sweep_report import write_sweep_report

CABLE, MOTION = "cable · black · h264", "motion-only · blur · h264"
SHORT_CABLE, SHORT_MOTION, SHORT_ANCHOR = "cable · black", "motion-only · blur", "full-frame"
"""As the report names them, since H.264 is what all have in common."""
HOSTILE = '<img src="x" onerror="window.broken=1"></script>'


def markup(path: Path) -> str:
    """The page without its scripts."""
    return re.sub(r"<script.*?</script>", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)


def rows_of(page: str, section: str) -> dict[str, list[str]]:
    """Texts of the method table of a quality, by method."""
    part = page.split(f'data-for-quality="{section}"', 1)[1].split("<tbody>", 1)[1].split("</tbody>", 1)[0]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in part.split("</tr>")]
    return {html.unescape(row[0]): [re.sub("<small>.*", "", cell) for cell in row[1:]] for row in rows if row}


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reported run's folder, exports included."""
    folder = tmp_path_factory.mktemp("run")
    write_sweep_report(replace(sweep_run(folder), qualities=("retention",)), bootstrap=Bootstrap(draws=40))
    return folder


def test_table_holds_what_the_curves_were_made_of(reported: Path) -> None:
    rows = rows_of(markup(reported / "report.html"), "retention")
    mean_bytes = sum(40_000 * (1 + 0.5 * number) for number in range(len(SEQUENCES))) / len(SEQUENCES)
    at_95 = mean_bytes * 2 ** (-(26 - 22) / 6) * 10 * 8 / 1000
    assert KEPT[CRFS.index(26)] == 19, "the setting that keeps 95 %"
    assert rows[SHORT_ANCHOR][:3] == ["–", "–", f"{at_95:.0f}"]
    cable = rows[SHORT_CABLE]
    assert cable == [
        "-40.0", cable[1], f"{0.6 * at_95:.0f}", "40.0 %", cable[4], "40.0 %", "100", "0 (anchor 0)", SHORT_ANCHOR
    ]  # fmt: skip
    assert rows[SHORT_MOTION][3] == "10.0 %"
    assert rows[SHORT_MOTION][0] == "-10.0"


def test_head_says_what_was_swept_and_what_it_means(reported: Path) -> None:
    page = markup(reported / "report.html")
    assert "72 cells · 4 sequences · 3 methods" in page
    assert "1 failed · 2 not measured yet" in page
    assert "-40.0 %" in page.split("<h2>")[0]
    assert "52.5 %" in page.split("<h2>")[0], "1 - (1 + 3 · 0.3) / 4 of the pixels"
    assert "pseudo ground truth" in page
    assert "no measure of bytes" in page


def test_failed_cell_is_shown_and_escaped(reported: Path) -> None:
    page = markup(reported / "report.html")
    assert "synthetic:&lt;b&gt;drive&lt;/b&gt;: out of &amp; memory" in page
    assert "synthetic:drive-a, cable · black, q 50" in page
    assert "axes: &amp;all [1, 2]" in page


def test_page_loads_nothing(reported: Path) -> None:
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:)[^"']""", markup(reported / "report.html"))


def test_exports_are_whole_and_sized_for_papers(reported: Path) -> None:
    folder = reported / "export"
    for name in ("rate_quality_retention", "byte_kinds", "pixels_bytes"):
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert cv2.imread(str(folder / f"{name}.png")).shape[1] == 1050, "3.5 in at 300 dpi"
    assert cv2.imread(str(folder / "rate_quality_retention_wide.png")).shape[1] == 2100
    latex = (folder / "bd_rates.tex").read_text()
    assert r"cable $\cdot$ black" in latex
    assert "$-$40.0" in latex
    assert "| -40.0 |" in re.sub(" +", " ", (folder / "bd_rates.md").read_text())
    assert not list(folder.glob("*.part"))


def test_curves_file_holds_every_point(reported: Path) -> None:
    with (reported / "export" / "curves.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["quality"] == "retention" and row["method"] == SHORT_CABLE]
    single = {(row["sequence"], row["setting"]): row for row in rows}
    assert len(rows) == len(single) == len(CRFS) * (1 + len(SEQUENCES))
    row = single["drive-b", "q 34"]
    assert float(row["rate_kbps"]) == pytest.approx(round(0.6 * 1.5 * 40_000 / 4) * 80 / 1000)
    assert float(row["value"]) == pytest.approx(100 * 16 / 20)
    assert row["value_low"] == ""
    assert float(single["", "q 34"]["rate_kbps_low"]) < float(single["", "q 34"]["rate_kbps"])


def test_names_from_outside_stay_text(tmp_path: Path) -> None:
    run = replace(sweep_run(tmp_path, sequences=(HOSTILE, "plain")), name=HOSTILE, text=HOSTILE)
    page = write_sweep_report(replace(run, qualities=()), quality="retention", export=False).read_text(encoding="utf-8")
    assert '<img src="x"' not in page
    assert page.count("</script>") == 3
    assert "&lt;img src=" in page
    assert not (tmp_path / "export").exists()


def test_two_curves_that_cannot_be_compared_say_why(tmp_path: Path) -> None:
    run = sweep_run(tmp_path)
    few = tuple(cell for cell in run.cells if cell.cell.strategy != "cable" or cell.cell.rate.quality in (22, 26))
    page = markup(write_sweep_report(replace(run, cells=few, qualities=("retention",)), export=False))
    assert rows_of(page, "retention")[SHORT_CABLE][0] == "–"
    assert re.search(r"BD-rate: .*more CRFs", page)


def test_run_without_a_measured_cell_is_refused(tmp_path: Path) -> None:
    run = sweep_run(tmp_path)
    with pytest.raises(ConfigurationError, match=r"no measured cell.*out of & memory"):
        write_sweep_report(replace(run, cells=run.cells[-1:]))
    with pytest.raises(ConfigurationError, match="no method of this run is called 'jpeg'"):
        write_sweep_report(run, anchor="jpeg")
    with pytest.raises(ConfigurationError, match="no quality 'beauty'"):
        write_sweep_report(run, quality="beauty")


def at_rate(cells: list[MeasuredCell], fps: float) -> list[MeasuredCell]:
    return [replace(cell, cell=replace(cell.cell, clip=replace(cell.cell.clip, fps=fps))) for cell in cells]


def test_methods_are_compared_at_their_own_frame_rate() -> None:
    one = ("drive-a",)
    whole, cable = method_cells("full-frame", "whole", 1.0, 1.0, one), method_cells("cable", "black", 0.5, 0.3, one)
    methods = cells_by_method([*whole, *at_rate(whole, 5), *cable, *at_rate(cable, 5), *at_rate(cable, 2.5)])
    slow = f"{ANCHOR} · 5 fps"
    assert anchors_of(methods, ANCHOR) == {
        ANCHOR: None, slow: None, CABLE: ANCHOR, f"{CABLE} · 5 fps": slow, f"{CABLE} · 2.5 fps": ANCHOR
    }  # fmt: skip
    assert set(anchors_of(methods, CABLE, for_all=True).values()) == {None, CABLE}
    styles = method_styles(tuple(methods), (ANCHOR, slow))
    assert len({(style.colour, style.marker) for style in styles.values()}) == len(methods) - 1


def test_bytes_are_compared_at_equal_codec_and_setting() -> None:
    def measured(size: int, strategy: str, **changes: object) -> MeasuredCell:
        return MeasuredCell(cell_of("drive-a", strategy, "black", 28, **changes), result_of("drive-a", size, 9, 0.5))

    link = SimulatedLink("slow", 500.0)
    cells = [
        measured(1000, "full-frame"),
        measured(400, "full-frame", codec="hevc"),
        measured(100, "full-frame", link=link),
        measured(250, "cable"),
        measured(300, "cable", codec="hevc"),
        measured(300, "cable", codec="jpeg"),
        measured(300, "cable", rate=RatePoint(bitrate_kbps=500)),
        measured(200, "cable", link=link),
    ]
    savings = [saving for _, saving in byte_savings(cells_by_method(cells))]
    assert savings == pytest.approx([0.75, 0.25, 0.8])
    facts = facts_of([cells[3]])
    assert facts.pixel_saving == pytest.approx(1 - (1 + 3 * 0.5) / 4)
    assert facts.p95_ms == pytest.approx(42.85)


def test_examples_stand_beside_the_anchor_at_its_rate() -> None:
    one = ("drive-a",)
    cells = [*method_cells("full-frame", "whole", 1.0, 1.0, one), *method_cells("cable", "black", 0.1, 0.3, one)]
    (row,) = example_rows(cells_by_method(cells), (ANCHOR,)).rows
    assert row.rate_kbps == pytest.approx(round(40_000 * 2 ** (-20 / 6)) * 80 / 1000)
    anchor, cable = row.examples
    assert anchor.off_rate == cable.off_rate == "", "4000 against 3969 bytes a frame"
    assert "q 22" in cable.caption
    assert cable.uri.startswith("data:image/jpeg;base64,")


def test_example_far_from_the_rate_says_so_and_the_page_stays_small() -> None:
    names = [f"drive-{number}" for number in range(40)]
    cells = [*method_cells("full-frame", "whole", 1.0, 1.0, names), *method_cells("cable", "black", 0.01, 0.3, names)]
    rows = example_rows(cells_by_method(cells), (ANCHOR,))
    assert rows.rows[0].examples[1].off_rate == "-96 % bit rate", "400 bytes of 10 000"
    assert sum(len(row.examples) for row in rows.rows) == MOST_PICTURES
    assert rows.left_out == 10


def stored(run: SweepRun) -> Path:
    """The run as a sweep leaves it on disk."""
    with CellStore(run.folder / "cells.sqlite") as store:
        for cell in run.cells:
            store.keep(cell.key or "failed", cell)
    keys = [cell.key or "failed" for cell in run.cells]
    labels = [list(asdict(CellLabels.of(cell.cell)).values()) for cell in run.cells]
    RunFile(
        run.name, run.anchor, run.qualities, run.retention_levels, run.text, (), run.command, run.environment,
        "cells.sqlite", keys, labels, run.started,
    ).write(run.folder)  # fmt: skip
    return run.folder


def test_names_leave_out_what_all_methods_share():
    whole = "full-frame · h264 · 10 fps"
    frozen, thin = (f"cable · frozen · {codec} · 10 fps" for codec in ("h264", "vp9"))
    assert short_names((whole, frozen)) == ShortNames({whole: "full-frame", frozen: "cable · frozen"}, "h264 · 10 fps")
    assert short_names((frozen, thin)).of == {frozen: "cable · h264", thin: "cable · vp9"}
    assert short_names((whole,)) == ShortNames({whole: whole}, "")
    assert short_names(("cable · a · b", "cable · b · a")).common == "", "two methods never get one name"


def test_command_reports_a_stored_sweep(tmp_path: Path) -> None:
    folder = stored(replace(sweep_run(tmp_path), qualities=("retention",)))
    ran = CliRunner().invoke(app, ["report", str(folder), "--draws", "0", "--no-export"])
    assert ran.exit_code == 0, ran.output
    assert "report.html" in ran.output
    assert rows_of(markup(folder / "report.html"), "retention")[SHORT_CABLE][0] == "-40.0"


def test_command_makes_a_stream_report_again_and_refuses_other_folders(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"holds no run.*run\.json.*frames\.csv"):
        report(tmp_path)
    records = [FrameRecord(0, 0, "answered", bitstream_bytes=10, uplink_message_bytes=20)]
    write_frames(tmp_path / "frames.csv", records)
    info = RunInfo("clip", 640, 480, 10.0, "h264", "CRF 28", "cable", "paper")
    write_summary(tmp_path, summarise(records, info))
    report(tmp_path)
    assert "clip" in markup(tmp_path / "report.html")


def test_a_method_at_several_scales_is_also_one_that_takes_the_better(tmp_path: Path) -> None:
    names = SEQUENCES
    whole = method_cells("full-frame", "whole", 1.0, 1.0, names)
    full, half = method_cells("cable", "black", 0.6, 0.3, names), method_cells("cable", "black", 0.3, 0.3, names)
    halved = tuple(
        replace(one, cell=replace(one.cell, treatment=replace(one.cell.treatment, scale=0.5))) for one in half
    )
    repeated = at_any_scale((*whole, *full, *halved))
    assert {one.cell.method for one in repeated} == {f"{CABLE} · any scale"}
    assert len(repeated) == len(full) + len(halved)
    assert all(is_repeated(one.cell) for one in repeated)
    assert len({(one.cell.clip, one.cell.setting) for one in repeated}) == len(repeated), "no setting twice"
    run = replace(sweep_run(tmp_path), cells=(*whole, *full, *halved), qualities=("retention",))
    page = markup(write_sweep_report(run, export=False))
    rows = rows_of(page, "retention")
    assert rows["cable · black · any scale"][0] == rows["cable · black · scale 0.5"][0], "the cheaper of the two"
    assert f"{len(run.cells)} cells" in page


def test_chosen_methods_stand_beside_their_anchor_alone(tmp_path: Path) -> None:
    run = replace(sweep_run(tmp_path), qualities=("retention",))
    rows = rows_of(markup(write_sweep_report(run, only=(SHORT_CABLE,), export=False)), "retention")
    assert set(rows) == {SHORT_ANCHOR, SHORT_CABLE}
    rows = rows_of(markup(write_sweep_report(run, anchor=SHORT_MOTION, export=False)), "retention")
    assert rows[SHORT_CABLE][-1] == SHORT_MOTION
    with pytest.raises(ConfigurationError, match="no method of this run is called 'x'; choose of: "):
        write_sweep_report(run, only=("x",), export=False)
