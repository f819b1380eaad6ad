"""How many frames may be unanswered, and how often one may be taken from the camera."""

from __future__ import annotations

import asyncio
import time


class Credit:
    """Places for unanswered frames; their number may change while they are taken."""

    def __init__(self) -> None:
        self._window = 0
        self._taken = 0
        self._room = asyncio.Event()

    @property
    def window(self) -> int:
        """Places in all."""
        return self._window

    async def acquire(self) -> None:
        """Waits for a place and takes it."""
        while self._taken >= self._window:
            self._room.clear()
            await self._room.wait()
        self._taken += 1

    def release(self) -> None:
        """Gives a place back."""
        self._taken -= 1
        self._room.set()

    def resize(self, window: int) -> None:
        """Changes the number of places; those taken stay taken."""
        self._window = window
        self._room.set()

    def reset(self, window: int) -> None:
        """Begins anew with all places free; those taken need not be given back."""
        self._taken = 0
        self.resize(window)


class FramePacer:
    """Keeps frames below a rate that may change; one frame that came late may be made up for."""

    def __init__(self) -> None:
        self._due_s = 0.0

    async def wait(self, most_per_s: float) -> None:
        """Waits until the next frame is due; at once where the rate is 0, which stands for any."""
        if most_per_s <= 0:
            return
        now_s = time.monotonic()
        interval_s = 1 / most_per_s
        due_s = max(self._due_s, now_s - interval_s)
        self._due_s = due_s + interval_s
        if due_s > now_s:
            await asyncio.sleep(due_s - now_s)
