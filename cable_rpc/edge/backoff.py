"""When to knock again: exponential, with jitter, so that a fleet does not come back all at once."""

from __future__ import annotations

import random

FIRST_S = 0.5
LONGEST_S = 3.0
JITTER = 0.25


class Backoff:
    """Waits between the attempts to reach a server."""

    def __init__(self) -> None:
        self._attempts = 0

    def next_s(self, retry_after_s: float | None = None) -> float:
        """Seconds to wait before the next attempt.

        Up to half a second before the first, then 0.5 s, doubling up to 3 s, each up to a quarter longer or shorter.

        Args:
            retry_after_s: what the server asked for; its wait comes before ours.
        """
        wait_s = random.uniform(0, FIRST_S)  # noqa: S311 - no secret
        if self._attempts:
            exponential_s = min(LONGEST_S, FIRST_S * 2 ** min(self._attempts - 1, 10))
            wait_s = exponential_s * random.uniform(1 - JITTER, 1 + JITTER)  # noqa: S311
        self._attempts += 1
        return wait_s + (retry_after_s or 0.0)
