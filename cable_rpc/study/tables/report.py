"""Everything that comes of a run of `cable-rpc tables`: on the terminal, as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from rich.console import Group, RenderableType
from rich.text import Text

import cable_rpc
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.run_record import write_text
from cable_rpc.study.sequence_metrics import AP_FIGURES, FIGURES, Bootstrap
from cable_rpc.study.tables.build_tables import Pooled, pooled_cells, table_one, table_two
from cable_rpc.study.tables.cells import Cell
from cable_rpc.study.tables.draw_csv import draw_csv, texts_of
from cable_rpc.study.tables.draw_latex import draw_latex
from cable_rpc.study.tables.draw_markdown import draw_markdown
from cable_rpc.study.tables.draw_terminal import draw_terminal
from cable_rpc.study.tables.equal_quality import EQUAL_QUALITY_FIGURES
from cable_rpc.study.tables.notes import table_notes
from cable_rpc.study.tables.result_table import ResultTable
from cable_rpc.study.tables.settings import RunSettings

MARKDOWN_FILE = "tables.md"
FIGURES_FILE = "figures.csv"
SHOWN_DAMAGE = 5
"""Pieces of damage that the terminal shows; all are in the Markdown file."""
SHOWN_FAILURES = 5
"""Sequences named for each reason."""


@dataclass(frozen=True)
class TableReport:
    """The tables of measured cells."""

    cells: Sequence[Cell]
    strategies: Sequence[str]
    """In the order of the rows; the first is that of table I."""
    settings: RunSettings
    by_frame: bool = False
    """True averages over frames as the paper does."""
    wanted: Sequence[str] = ("1", "2")
    workers: int = 1
    """How many sequences were measured at a time."""
    command_line: str = ""

    @property
    def failed(self) -> list[Cell]:
        """Cells without figures."""
        return [cell for cell in self.cells if cell.error]

    @cached_property
    def pooled(self) -> Pooled:
        """All data sets under all strategies."""
        return pooled_cells(self.cells, Bootstrap())

    @cached_property
    def tables(self) -> list[ResultTable]:
        """Those that are wanted."""
        notes = table_notes(self.cells, self.settings, by_frame=self.by_frame, workers=self.workers)
        mode = self.settings.roi.mode
        found = []
        if "1" in self.wanted:
            found.append(table_one(self.pooled, self.strategies[0], by_frame=self.by_frame, mode=mode, notes=notes))
        if "2" in self.wanted:
            found.append(table_two(self.pooled, self.strategies, by_frame=self.by_frame, mode=mode, notes=notes))
        return found

    @property
    def damage(self) -> list[str]:
        """What was skipped, each piece of damage once."""
        return list(dict.fromkeys(line for cell in self.cells for line in cell.skipped))

    @property
    def failures(self) -> list[str]:
        """Each reason once, with the cells that failed for it."""
        reasons: dict[str, dict[str, list[str]]] = {}
        for cell in self.failed:
            reasons.setdefault(cell.error, {}).setdefault(cell.sequence or cell.request.spec, []).append(cell.strategy)
        return [f"{listed(sequences)}: {error}" for error, sequences in reasons.items()]

    def draw(self) -> RenderableType:
        """For a terminal of 120 columns."""
        parts: list[RenderableType] = []
        if self.pooled:
            parts += [drawn for table in self.tables for drawn in (draw_terminal(table), Text())]
            parts += [Text(f"· {note}", style="dim") for note in self.tables[0].notes] if self.tables else []
        parts += [Text(f"skipped: {line}", style="yellow") for line in self.damage[:SHOWN_DAMAGE]]
        if len(self.damage) > SHOWN_DAMAGE:
            more = len(self.damage) - SHOWN_DAMAGE
            parts.append(Text(f"skipped: {more} more, listed in {MARKDOWN_FILE}", style="yellow"))
        parts += [Text(f"failed: {line}", style="red") for line in self.failures]
        return Group(*parts)

    def markdown(self) -> str:
        """Both tables with their notes, what was left out, and how to make them again."""
        lines = ["# CABLE tables", ""]
        lines += [draw_markdown(table) for table in self.tables]
        lines += ["## Notes", "", *(f"- {note}" for note in (self.tables[0].notes if self.tables else ())), ""]
        for title, found in (("Left out as damaged", self.damage), ("Failed", self.failures)):
            lines += [f"## {title}", "", *(f"- {line}" for line in found), ""] if found else []
        lines += [f"Made with cable-rpc {cable_rpc.__version__} by `{self.command_line}`.", ""]
        return "\n".join(lines)

    def figures(self) -> str:
        """Every figure there is, by both definitions, as CSV."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["data_set", "strategy", "figure", "value", "low", "high", "meaning"])
        meanings = {name: figure.meaning for name, figure in FIGURES.items()}
        meanings |= dict.fromkeys(AP_FIGURES, "COCO's average precision") | dict(EQUAL_QUALITY_FIGURES)
        for (dataset, strategy), found in self.pooled.items():
            for name, meaning in meanings.items():
                writer.writerow([dataset, strategy, name, *texts_of(found.figure(name), intervals=True), meaning])
        return text.getvalue()

    def texts(self) -> dict[str, str]:
        """All files by name; none where no cell was measured."""
        if not self.pooled:
            return {}
        texts = {MARKDOWN_FILE: self.markdown(), FIGURES_FILE: self.figures()}
        for table in self.tables:
            texts[f"{table.key}.tex"] = draw_latex(table)
            texts[f"{table.key}.csv"] = draw_csv(table)
        return texts


def listed(sequences: Mapping[str, Sequence[str]]) -> str:
    """Sequences with their strategies, the first few by name."""
    shown = [f"{name} ({', '.join(strategies)})" for name, strategies in sequences.items()]
    more = len(shown) - SHOWN_FAILURES
    return "; ".join(shown[:SHOWN_FAILURES]) + (f"; and {more} more" if more > 0 else "")


def write_report(report: TableReport, folder: Path) -> list[Path]:
    """Write all files, each whole or not at all.

    Returns:
        Their paths; none where no cell was measured.

    Raises:
        ConfigurationError: the folder can't be written to.
    """
    texts = report.texts()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(folder / name, text)
    except OSError as error:
        raise ConfigurationError(f"can't write the tables to {folder}: {error.strerror or error}") from error
    return [folder / name for name in texts]
