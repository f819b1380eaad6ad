"""Splits the time of one frame into named stages."""

from __future__ import annotations

import time

from cable_rpc.types import StageTimings


class StageClock:
    """Starts when made."""

    def __init__(self) -> None:
        self._stages_ns: dict[str, int] = {}
        self._since = time.perf_counter_ns()

    def lap(self, stage: str) -> None:
        """Charge the time since the last lap to a stage."""
        now = time.perf_counter_ns()
        self._stages_ns[stage] = self._stages_ns.get(stage, 0) + now - self._since
        self._since = now

    @property
    def timings(self) -> StageTimings:
        """What the stages took so far."""
        return StageTimings(dict(self._stages_ns))
