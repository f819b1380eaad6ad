"""Live progress of a run on the terminal."""

from __future__ import annotations

import time
from collections import deque

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from cable_rpc.study.run_record import FrameRecord

WINDOW = 20
"""Frames over which the shown figures are averaged."""

PASS_TITLES = {"stream": "streaming", "evaluate": "same frames whole"}


class RunProgress:
    """Context manager whose `update` is a run's listener: frames/s, kbit/s, coverage, staleness, latency."""

    def __init__(self, console: Console, frame_count: int | None, fps: float) -> None:
        self._fps = fps
        self._frame_count = frame_count
        self._recent: deque[tuple[float, FrameRecord]] = deque(maxlen=WINDOW)
        self._tasks: dict[str, TaskID] = {}
        self._progress = Progress(
            TextColumn("{task.description:<17}"),
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[figures]}"),
            console=console,
        )

    def __enter__(self) -> RunProgress:
        self._progress.__enter__()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._progress.stop()

    def update(self, name: str, record: FrameRecord) -> None:
        """Shows one more frame of a pass."""
        if name not in self._tasks:
            self._recent.clear()
            self._tasks[name] = self._progress.add_task(PASS_TITLES[name], total=self._frame_count, figures="")
        self._recent.append((time.monotonic(), record))
        figures = self._stream_figures() if name == "stream" else self._rate()
        self._progress.update(self._tasks[name], advance=1, figures=figures)

    def _rate(self) -> str:
        elapsed = self._recent[-1][0] - self._recent[0][0]
        return f"{(len(self._recent) - 1) / elapsed:5.1f} fps" if elapsed > 0 else ""

    def _stream_figures(self) -> str:
        records = [record for _, record in self._recent]
        count = len(records)
        coverage = sum(record.coverage or 0 for record in records) / count
        kbps = sum(record.uplink_message_bytes for record in records) / count * 8 * self._fps / 1e3
        stale = [record.staleness_frames for record in records if record.staleness_frames is not None]
        latencies = [record.end_to_end_ns for record in records if record.end_to_end_ns is not None]
        parts = [self._rate(), f"{kbps:6.0f} kbit/s", f"{100 * coverage:3.0f} % px"]
        if stale:
            parts.append(f"mask {sum(stale) / len(stale):.1f} old")
        if latencies:
            parts.append(f"{sum(latencies) / len(latencies) / 1e6:3.0f} ms")
        return "  ".join(parts)
