"""Log lines that a stranger can cause: at most one a second, with the number of those left out."""

from __future__ import annotations

import logging
import time

INTERVAL_S = 1.0


class ThrottledWarning:
    """One kind of warning."""

    def __init__(self, log: logging.Logger, interval_s: float = INTERVAL_S) -> None:
        self._log = log
        self._interval_s = interval_s
        self._next_s = 0.0
        self._left_out = 0

    def __call__(self, message: str, *values: object) -> None:
        """Logs a warning, or counts it."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            self._left_out += 1
            return
        suffix = f" ({self._left_out} more like it before)" if self._left_out else ""
        self._next_s, self._left_out = now_s + self._interval_s, 0
        self._log.warning(message + suffix, *values)
