"""Values of text rows, each checked where it is read."""

from __future__ import annotations

import math

from cable_rpc.errors import SourceError

LARGEST_ID = 2**31 - 1


def whole_number(word: str, column: str, place: str) -> int:
    """A whole number of at least 0.

    Raises:
        SourceError: it is none, or has more than 31 bits.
    """
    if not (word.isascii() and word.isdecimal()) or int(word) > LARGEST_ID:
        raise SourceError(f"{place}: {column} is '{word}'; it must be a whole number, 0 or more")
    return int(word)


def finite_number(word: str, column: str, place: str) -> float:
    """A finite number.

    Raises:
        SourceError: it is none.
    """
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SourceError(f"{place}: {column} is '{word}'; it must be a finite number")
    return value
