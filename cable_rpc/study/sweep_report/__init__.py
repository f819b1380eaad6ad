"""The report of a sweep: one HTML file, and figures and tables for papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.report_page import study_extra_missing
from cable_rpc.study.run_record import REPORT_FILE, write_text
from cable_rpc.study.sweep.cell import MeasuredCell
from cable_rpc.study.sweep.qualities import find_quality
from cable_rpc.study.sweep.run_folder import SweepRun
from cable_rpc.study.sweep_report.methods import (
    anchors_of,
    at_any_scale,
    cells_by_method,
    method_styles,
    renamed,
    short_names,
    whole_label,
)

EXPORT_FOLDER = "export"


def write_sweep_report(
    run: SweepRun,
    *,
    quality: str | None = None,
    anchor: str | None = None,
    only: Sequence[str] = (),
    bootstrap: Bootstrap | None = None,
    export: bool = True,
) -> Path:
    """Write ``report.html`` into the run's folder, and figures and tables for papers below it.

    Args:
        run: measured cells and what they were measured with.
        quality: that the report opens with; the configuration's first by default. The configuration's others follow.
        anchor: the method that all others are compared with, by its name in the report or its whole label; by default
            the configuration's anchor, at the frame rate of each method.
        only: names or whole labels of the methods to show, beside their anchors; none shows all.
        bootstrap: how intervals are drawn; None for none.
        export: whether ``export/`` is written.

    Returns:
        The page's path.

    Raises:
        ConfigurationError: no cell was measured, the quality or anchor is unknown, a file can't be written, or the
            ``study`` extra is not installed.
    """
    try:
        from cable_rpc.study.sweep_report.content import gather
        from cable_rpc.study.sweep_report.exports import write_exports
        from cable_rpc.study.sweep_report.page import page_text
    except ImportError as error:
        raise study_extra_missing(error) from error
    run = replace(run, cells=(*run.cells, *at_any_scale(run.cells)))
    methods = cells_by_method(run.cells)
    if not methods:
        failed = f"; the first says: {run.cells[0].error}" if run.cells else ""
        raise ConfigurationError(
            f"{run.folder} has no measured cell to report, {len(run.cells)} failed and {run.missing} were not "
            f"tried{failed}"
        )
    names = tuple(dict.fromkeys([quality] if quality else []) | dict.fromkeys(run.qualities))
    for name in names:
        find_quality(name)
    whole = whole_label(anchor, tuple(methods)) if anchor else run.anchor
    compared = shown(anchors_of(methods, whole, for_all=anchor is not None), only)
    short = short_names(tuple(compared))
    run = replace(run, cells=renamed([cell for cell in run.cells if is_shown(cell, compared)], short.of))
    methods = cells_by_method(run.cells)
    compared = {short.of[label]: short.of[other] if other else None for label, other in compared.items()}
    anchors = tuple(dict.fromkeys(label for label in compared.values() if label))
    styles = method_styles(tuple(methods), anchors)
    content = gather(run, methods, compared, styles, names, bootstrap, common=short.common)
    path = run.folder / REPORT_FILE
    try:
        write_text(path, page_text(content))
        if export:
            write_exports(content, run.folder / EXPORT_FOLDER)
    except OSError as error:
        raise ConfigurationError(f"can't write the report into {run.folder}: {error.strerror or error}") from error
    return path


def shown(compared: Mapping[str, str | None], only: Sequence[str]) -> dict[str, str | None]:
    """The methods to show with what each is compared with; anchors are always among them.

    Raises:
        ConfigurationError: there is no method of a name.
    """
    if not only:
        return dict(compared)
    chosen = {whole_label(name, tuple(compared)) for name in only}
    chosen |= {other for label, other in compared.items() if label in chosen and other}
    return {label: other for label, other in compared.items() if label in chosen}


def is_shown(measured: MeasuredCell, compared: Mapping[str, str | None]) -> bool:
    """Whether a cell belongs to a method that is shown, or failed."""
    return measured.cell.method in compared or measured.result is None
