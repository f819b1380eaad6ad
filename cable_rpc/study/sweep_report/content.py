"""All that the report of a sweep is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.sweep.cell import MeasuredCell
from cable_rpc.study.sweep.run_folder import SweepRun
from cable_rpc.study.sweep_report.comparison import QualityResult, quality_result
from cable_rpc.study.sweep_report.methods import MethodStyle, is_repeated

USUAL_LEVEL = 95.0
"""Retention in percent at which bytes are looked at where the run names no level."""


@dataclass(frozen=True, slots=True)
class ReportContent:
    """Everything that the page, its plots and its tables are made of."""

    run: SweepRun
    methods: Mapping[str, Sequence[MeasuredCell]]
    """Measured cells by label."""
    anchors: tuple[str, ...]
    """Labels that others are compared with."""
    styles: Mapping[str, MethodStyle]
    results: tuple[QualityResult, ...]
    """The main quality first."""
    level: float
    """Retention in percent at which bytes are looked at."""
    common: str = ""
    """What all methods have in common, and their labels leave out."""

    @property
    def main(self) -> QualityResult:
        """By the quality that the report opens with."""
        return self.results[0]

    @property
    def measured(self) -> list[MeasuredCell]:
        """All measured cells, each once."""
        return [cell for cells in self.methods.values() for cell in cells if not is_repeated(cell.cell)]

    @property
    def failed(self) -> list[MeasuredCell]:
        """Cells without a result."""
        return [cell for cell in self.run.cells if cell.result is None and not is_repeated(cell.cell)]


def gather(
    run: SweepRun,
    methods: Mapping[str, Sequence[MeasuredCell]],
    compared: Mapping[str, str | None],
    styles: Mapping[str, MethodStyle],
    qualities: Sequence[str],
    bootstrap: Bootstrap | None,
    *,
    common: str = "",
) -> ReportContent:
    """Compare methods by each quality that was measured.

    Args:
        run: of which the report is.
        methods: measured cells by label.
        compared: each method's anchor, None for none.
        styles: of every method.
        qualities: names, the main one first.
        bootstrap: how to draw sequences; None for no intervals.
        common: what all methods have in common, and their labels leave out.

    Raises:
        ConfigurationError: none of the qualities was measured.
    """
    levels = run.retention_levels
    found = tuple(quality_result(run.cells, name, compared, levels, bootstrap) for name in qualities)
    results = tuple(result for result in found if result.methods)
    if not results:
        raise ConfigurationError(
            f"none of {', '.join(qualities)} could be measured on these sequences; choose another with --quality"
        )
    anchors = tuple(dict.fromkeys(label for label in compared.values() if label))
    return ReportContent(run, methods, anchors, styles, results, levels[0] if levels else USUAL_LEVEL, common)
