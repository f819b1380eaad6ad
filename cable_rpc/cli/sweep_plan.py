"""What a sweep is about to do, for ``--dry-run``."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from rich.table import Table

from cable_rpc.study.sweep.cell import ANCHOR_STRATEGY, SweepCell
from cable_rpc.study.sweep.config import SweepConfig
from cable_rpc.study.sweep.identity import cell_keys
from cable_rpc.study.sweep.store import CellStore

MOST_VALUES = 12
"""Of an axis that are listed."""
MOST_TIMED = 200
"""Stored cells that an estimate looks at."""


def render_plan(plan: SweepConfig, store: Path, workers: int) -> Table:
    """Axes, cells, how many are done, and how long the others take, judged by those that are done."""
    table = Table(title=f"sweep {plan.name}", title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(justify="right")
    table.add_column()
    for axis, values in axes_of(plan.cells).items():
        more = len(values) - MOST_VALUES
        shown = ", ".join(list(values)[:MOST_VALUES]) + (f" and {more} more" if more > 0 else "")
        table.add_row(axis, str(len(values)), shown)
    found, seconds = stored(plan, store)
    missing = len(plan.cells) - found
    table.add_row(
        "cells", str(len(plan.cells)), f"{plan.anchor}, the anchor, included; equal ones once", end_section=True
    )
    table.add_row("done", str(found), f"in {store}")
    table.add_row("to do", str(missing), estimate(missing, seconds, workers))
    return table


def axes_of(cells: tuple[SweepCell, ...]) -> dict[str, dict[str, None]]:
    """Each axis with the values that occur, in the order of the cells."""
    axes: dict[str, dict[str, None]] = {}
    for cell in cells:
        values = {
            "sequences": cell.clip.source,
            "strategies": cell.strategy,
            "treatments": cell.treatment_label,
            "codecs": cell.codec,
            "rates": f"{cell.codec} {cell.rate.label}",
            "fps": "own" if cell.clip.fps is None else f"{cell.clip.fps:g}",
            "upload scales": f"{cell.treatment.scale:g}",
            "feedback delays": str(cell.feedback_delay),
            "links": "none" if cell.link is None else cell.link.name,
            "ROI settings": cell.roi_label,
        }
        if cell.strategy == ANCHOR_STRATEGY:
            # Whole frames have neither.
            del values["treatments"], values["ROI settings"]
        for axis, value in values.items():
            axes.setdefault(axis, {})[value] = None
    return axes


def stored(plan: SweepConfig, path: Path) -> tuple[int, float | None]:
    """How many cells are done, and seconds that one of them took on average; None without any."""
    if not path.is_file():
        return 0, None
    with CellStore(path) as store:
        known = store.keys()
        found = [key for key in cell_keys(plan.cells) if key in known]
        timed = [cell.seconds_taken for cell in map(store.find, found[:MOST_TIMED]) if cell is not None]
    return len(found), sum(timed) / len(timed) if timed else None


def estimate(missing: int, seconds: float | None, workers: int) -> str:
    """How long the rest takes."""
    if not missing:
        return "nothing is left"
    if seconds is None:
        return "no estimate before some are done; the run shows one as it goes"
    left = timedelta(seconds=round(seconds * missing / workers))
    return f"about {left} with {workers} workers, at {seconds:.1f} s a cell"
