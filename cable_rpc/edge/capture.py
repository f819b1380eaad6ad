"""Reading a source in a thread of its own, so that a slow link never blocks the camera."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

from cable_rpc.types import Frame


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """A frame and when the edge had it."""

    frame: Frame
    capture_ns: int
    """What reading or rendering it took."""
    available_time_ns: int
    """Monotonic clock; end-to-end latency counts from here."""


class Capture:
    """One slot between the camera and the loop.

    ``realtime``: frames come at the pace of their time stamps and a newer one replaces one that was not taken
    (it is counted in ``dropped``). Otherwise the source waits, and every frame is delivered.
    """

    def __init__(self, frames: Iterable[Frame], *, realtime: bool) -> None:
        self._frames = frames
        self.realtime = realtime
        self._slot: queue.Queue[CapturedFrame | BaseException | None] = queue.Queue(maxsize=1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="capture", daemon=True)
        self.dropped: list[int] = []
        """Indices of frames that a newer one replaced."""

    def start(self) -> None:
        """Begins to read."""
        self._thread.start()

    def stop(self) -> None:
        """Ends reading; a frame in the slot is lost."""
        self._stop.set()

    async def next_frame(self) -> CapturedFrame | None:
        """The next frame, or the newest one in real time; None at the end.

        Raises:
            SourceError: what the source raised.
        """
        item = await asyncio.to_thread(self._take)
        if isinstance(item, BaseException):
            raise item
        if item is None or self.realtime:
            return item
        # In lock-step the frame was read ahead and nobody was waiting for it: its life begins when it is taken.
        return replace(item, available_time_ns=time.monotonic_ns())

    def _take(self) -> CapturedFrame | BaseException | None:
        while not self._stop.is_set():
            try:
                return self._slot.get(timeout=0.1)
            except queue.Empty:
                continue
        return None

    def _read(self) -> None:
        try:
            self._read_frames()
            self._put(None)
        except BaseException as error:
            self._put(error)

    def _read_frames(self) -> None:
        frames = iter(self._frames)
        first_due_ns: int | None = None
        while not self._stop.is_set():
            started_ns = time.monotonic_ns()
            frame = next(frames, None)
            if frame is None:
                return
            read_ns = time.monotonic_ns() - started_ns
            if self.realtime:
                now_ns = time.monotonic_ns()
                if first_due_ns is None:
                    first_due_ns = now_ns - frame.capture_time_ns
                self._stop.wait(max(0, first_due_ns + frame.capture_time_ns - now_ns) / 1e9)
            self._put(CapturedFrame(frame, read_ns, time.monotonic_ns()), replace=self.realtime)

    def _put(self, item: CapturedFrame | BaseException | None, *, replace: bool = False) -> None:
        while not self._stop.is_set():
            try:
                self._slot.put(item, timeout=0 if replace else 0.1)
                return
            except queue.Full:
                if replace:
                    self._drop_oldest()

    def _drop_oldest(self) -> None:
        try:
            stale = self._slot.get_nowait()
        except queue.Empty:
            return
        if isinstance(stale, CapturedFrame):
            self.dropped.append(stale.frame.index)
