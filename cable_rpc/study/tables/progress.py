"""How far the cells of a table have come, on stderr."""

from __future__ import annotations

import time
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cable_rpc.study.tables.cells import Cell


class CellProgress:
    """Context manager whose `update` is the engine's listener: cells done and failed, rate, time left."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.done = 0
        self._found = 0
        self._failed = 0
        self._progress = Progress(
            TextColumn("measuring"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[last]}", style="dim"),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task("measuring", total=total, rate="", left="", last="")
        self._started = time.monotonic()

    def __enter__(self) -> CellProgress:
        self._progress.__enter__()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Takes the bar away."""
        self._progress.stop()

    def update(self, cell: Cell, was_there: bool) -> None:
        """One more cell is there."""
        self.done += 1
        self._found += was_there
        self._failed += bool(cell.error)
        rate = left = ""
        measured = self.done - self._found
        seconds = time.monotonic() - self._started
        if measured and not was_there and seconds > 0:
            # Cells come in bursts, a sequence's together, so the rate is that of the whole run; what was found in the
            # folder says nothing of how long the others will take.
            rate = f"{60.0 * measured / seconds:.1f} cells/min"
            left = f"{timedelta(seconds=round(seconds / measured * (self.total - self.done)))} left"
        if self._failed:
            rate += f" [red]{self._failed} failed[/red]"
        self._progress.update(self._task, advance=1, rate=rate, left=left, last=cell.title)
