"""Measured points of one way to send: bytes and quality of every sequence at every setting."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from cable_rpc.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class SequencePoint:
    """One sequence at one setting of one method.

    Quality is a ratio, so that sequences pool by adding both of its terms: objects found of all objects, the sum of
    average precisions over their number, decibels summed over frames over the number of frames.

    Raises:
        ConfigurationError: a value isn't finite or lies outside its range.
    """

    sequence: str
    setting: str
    """What was turned, e.g. ``crf 28``; points of equal setting pool over sequences."""
    bytes_up: int
    """All uplink bytes."""
    seconds: float
    """Duration of what was sent, above 0."""
    gained: float
    """Numerator of the quality."""
    possible: float
    """Denominator of the quality, at least 0; 0 where the sequence has nothing to find."""
    cell: str = ""
    """Key of the measured cell."""

    def __post_init__(self) -> None:
        numbers = (self.bytes_up, self.seconds, self.gained, self.possible)
        if not all(math.isfinite(number) for number in numbers):
            raise ConfigurationError(f"{self.place} has bytes, seconds, gained, possible {numbers}; all must be finite")
        if self.bytes_up < 0 or self.seconds <= 0 or self.possible < 0:
            raise ConfigurationError(
                f"{self.place} has {self.bytes_up} bytes in {self.seconds} s and {self.possible} to gain; bytes and "
                "what can be gained must be at least 0, the duration above 0"
            )

    @property
    def place(self) -> str:
        """Where the point stands, for messages."""
        return f"sequence '{self.sequence}' at '{self.setting}'"

    @property
    def rate_kbps(self) -> float:
        """Kilobits (1000 bits) per second."""
        return 8e-3 * self.bytes_up / self.seconds

    @property
    def quality(self) -> float | None:
        """``gained / possible``; None where nothing can be gained."""
        return self.gained / self.possible if self.possible > 0 else None


@dataclass(frozen=True, slots=True)
class Method:
    """One curve: everything measured of one strategy, treatment and codec; points in any order.

    Raises:
        ConfigurationError: a sequence has two points of one setting.
    """

    label: str
    """For people."""
    points: tuple[SequencePoint, ...]

    def __post_init__(self) -> None:
        places = Counter((point.sequence, point.setting) for point in self.points)
        for (sequence, setting), count in places.items():
            if count > 1:
                raise ConfigurationError(
                    f"'{self.label}' has {count} points of sequence '{sequence}' at '{setting}'; give one, or name "
                    "in the setting what differs"
                )

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names of the sequences, sorted."""
        return tuple(sorted({point.sequence for point in self.points}))

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the settings, sorted."""
        return tuple(sorted({point.setting for point in self.points}))

    def of_sequence(self, name: str) -> Method:
        """The points of one sequence under the same label.

        Raises:
            ConfigurationError: there is no such sequence.
        """
        if name not in self.sequences:
            raise ConfigurationError(f"'{self.label}' has no sequence '{name}'; it has {', '.join(self.sequences)}")
        return Method(self.label, tuple(point for point in self.points if point.sequence == name))
