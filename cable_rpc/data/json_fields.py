"""Values of JSON rows, each checked where it is read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cable_rpc.errors import SourceError

JsonRow = Mapping[str, Any]
Identifier = str | int
"""COCO's ids are whole numbers in the original set and texts in some others."""


def shown(value: Any) -> str:
    """A value as an error text shows it."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def identifier(row: JsonRow, key: str, place: str) -> Identifier:
    """An id.

    Raises:
        SourceError: it is missing, or neither a text nor a whole number.
    """
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise SourceError(f"{place}: {key} is {shown(value)}; an id is a whole number or a text")
    return value


def text(row: JsonRow, key: str, place: str) -> str:
    """A text that isn't empty.

    Raises:
        SourceError: it is missing or no such text.
    """
    value = row.get(key)
    if not isinstance(value, str) or not value:
        raise SourceError(f"{place}: {key} is {shown(value)}; it must be a text")
    return value


def number(row: JsonRow, key: str, place: str) -> float:
    """A finite number.

    Raises:
        SourceError: it is missing or no such number.
    """
    value = row.get(key)
    if not is_finite(value):
        raise SourceError(f"{place}: {key} is {shown(value)}; it must be a finite number")
    return float(row[key])


def side_px(row: JsonRow, key: str, place: str) -> int:
    """A side of an image in pixels.

    Raises:
        SourceError: it is no whole number above 0.
    """
    value = row.get(key)
    if not is_finite(value) or value != int(row[key]) or row[key] < 1:
        raise SourceError(f"{place}: {key} is {shown(value)}; an image has a whole number of pixels")
    return int(row[key])


def numbers(row: JsonRow, key: str, count: int, place: str) -> list[float]:
    """A list of finite numbers.

    Raises:
        SourceError: it is missing, of another length, or one of them is no finite number.
    """
    value = row.get(key)
    if not isinstance(value, list) or len(value) != count or not all(is_finite(entry) for entry in value):
        raise SourceError(f"{place}: {key} is {shown(value)}; it must be {count} finite numbers")
    return [float(entry) for entry in value]


def is_finite(value: Any) -> bool:
    """Whether a JSON value is a number other than NaN and the infinities."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
