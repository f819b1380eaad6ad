"""How far a sweep has come, on stderr."""

from __future__ import annotations

import time
from datetime import timedelta

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cable_rpc.study.sweep.cell import ClipRequest, MeasuredCell

PLAIN_EVERY_S = 10.0


class SweepProgress:
    """Context manager and `SweepListener`: cells done, found and failed, rate, time left, the last one's title.

    A bar on a terminal; otherwise a line now and then, and one at the end.

    Args:
        console: where to; None = stderr.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self.total = self.found = self.done = self.failed = 0
        self.clips = self.clips_done = 0
        self._last = ""
        self._started = self._told = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[last]}", style="dim"),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._bar.add_task("sweep", total=None, state="", last="")

    def __enter__(self) -> SweepProgress:
        self._bar.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._bar.stop()
        if self.total and not self.console.is_terminal:
            self.console.print(self.line, markup=False, highlight=False, soft_wrap=True)

    def planned(self, cells: int, found: int, clips: int) -> None:
        """What lies ahead."""
        self.total, self.found, self.clips = cells, found, clips
        self._bar.update(self._task, description="decoding", total=clips)
        self.tell(whatever=True)

    def prepared(self, clip: ClipRequest, error: str) -> None:
        """One more clip is there, or can't be."""
        self.clips_done += 1
        self._last = f"{clip.source}: {error}" if error else clip.source
        self._started = time.monotonic()
        self.tell()

    def measured(self, cell: MeasuredCell) -> None:
        """One more cell is there."""
        self.done += 1
        self.failed += bool(cell.error)
        self._last = cell.cell.title
        self.tell()

    @property
    def rate(self) -> float | None:
        """Cells per second since the clips are there; None before any."""
        seconds = time.monotonic() - self._started
        return self.done / seconds if self.done and seconds > 0 else None

    @property
    def state(self) -> str:
        """Found, failed, rate and time left."""
        parts = [f"{self.found} found"] if self.found else []
        if self.failed:
            parts.append(f"{self.failed} failed")
        if self.rate is not None:
            left = (self.total - self.found - self.done) / self.rate
            parts += [f"{self.rate:.2f} cells/s", f"{timedelta(seconds=round(left))} left"]
        return ", ".join(parts)

    @property
    def line(self) -> str:
        """Everything, for a log."""
        counts = f"clips {self.clips_done}/{self.clips}, " if self.clips_done < self.clips and not self.done else ""
        text = f"{counts}cells {self.found + self.done}/{self.total}"
        return ", ".join(part for part in (text, self.state, self._last) if part)

    def tell(self, *, whatever: bool = False) -> None:
        """Update the bar, or print a line where the last one is old."""
        if self.console.is_terminal:
            measuring = self.done or self.clips_done >= self.clips
            self._bar.update(
                self._task,
                description="measuring" if measuring else "decoding",
                total=self.total if measuring else self.clips,
                completed=self.found + self.done if measuring else self.clips_done,
                state=self.state,
                last=escape(self._last),
            )
        elif whatever or time.monotonic() - self._told >= PLAIN_EVERY_S:
            self._told = time.monotonic()
            self.console.print(self.line, markup=False, highlight=False, soft_wrap=True)
