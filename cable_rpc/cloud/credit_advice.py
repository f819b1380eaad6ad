"""How many frames a client should keep under way: fewer while the models are what it waits for."""

from __future__ import annotations

LOWER_ABOVE = 0.25
"""Share of frames that are overtaken before a model has a place for them."""
WEIGHT = 0.2
"""Of the latest frame in that share."""
SHORT_WAIT = 0.25
"""A wait for the models, in units of their run, that tells of spare room."""
RAISE_AFTER, RAISE_AFTER_AT_MOST = 8, 128
"""Frames in a row that find room before more credit is tried; doubled each time it was too much."""


class CreditAdvice:
    """Lowers the credit of a stream to one frame when its frames overtake each other at the models.

    A second frame under way fills the time of the uplink. Where the models are slower than the uplink it is only sent
    to be thrown away. The advice belongs into FlowUpdate; what is enforced stays the grant.

    Args:
        granted: frames that the session may have unanswered.
    """

    def __init__(self, granted: int) -> None:
        self._granted = granted
        self._overtaken_share = 0.0
        self._with_room = 0
        self._raise_after = RAISE_AFTER
        self.in_flight = granted
        """The advice."""

    def frame_taken(self, overtaken: int) -> None:
        """A model took a frame that had overtaken so many."""
        latest = overtaken / (overtaken + 1)
        self._overtaken_share += WEIGHT * (latest - self._overtaken_share)
        if self._overtaken_share > LOWER_ABOVE and self.in_flight > 1:
            self.in_flight = 1
            self._with_room = 0

    def frame_answered(self, wait_ns: int, run_ns: int) -> None:
        """The models answered a frame that had waited for them."""
        if self.in_flight == self._granted:
            return
        self._with_room = self._with_room + 1 if wait_ns < SHORT_WAIT * run_ns else 0
        if self._with_room >= self._raise_after:
            self.in_flight = self._granted
            self._overtaken_share = 0.0
            self._raise_after = min(2 * self._raise_after, RAISE_AFTER_AT_MOST)
