"""Capture times as raw KITTI and CADC write them: one line per frame, ``YYYY-MM-DD HH:MM:SS.nnnnnnnnn``."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from cable_rpc.errors import SourceError

NS_PER_S = 1_000_000_000
STAMP = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?")


def stamp_ns(text: str) -> int | None:
    """A time of day in ns since 1970, taken for UTC as no zone is written; None where the text is no such time.

    All nine digits count: 64-bit floats and `datetime` would lose the last ones.
    """
    match = STAMP.fullmatch(text.strip())
    if match is None:
        return None
    try:
        whole = datetime.fromisoformat(f"{match[1]} {match[2]}").replace(tzinfo=UTC)
    except ValueError:
        return None
    return int(whole.timestamp()) * NS_PER_S + int((match[3] or "").ljust(9, "0"))


def read_stamps(path: Path) -> list[int]:
    """Capture times of a sequence in ns, line ``n`` (from 0) for the file numbered ``n``.

    Raises:
        SourceError: the file can't be read, or a line is no time.
    """
    try:
        lines = path.read_text(encoding="utf-8").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"can't read time stamps {path}: {error}") from error
    stamps: list[int] = []
    for number, line in enumerate(lines, 1):
        stamp = stamp_ns(line)
        if stamp is None:
            raise SourceError(f"{path} line {number}: '{line}' is no time like 2018-03-06 15:02:33.123456789")
        stamps.append(stamp)
    return stamps


def read_stamps_by_number(path: Path) -> Callable[[int], int]:
    """Number of a file to its capture time in ns, which raises SourceError for a number without a line.

    Raises:
        SourceError: the file can't be read, or a line is no time.
    """
    stamps = read_stamps(path)

    def stamp_of(number: int) -> int:
        if number >= len(stamps):
            raise SourceError(f"{path} has {len(stamps)} lines, none for image {number}")
        return stamps[number]

    return stamp_of


def stamp_text(time_ns: int) -> str:
    """The line of a time in ns since 1970."""
    whole = datetime.fromtimestamp(time_ns // NS_PER_S, tz=UTC)
    return f"{whole:%Y-%m-%d %H:%M:%S}.{time_ns % NS_PER_S:09d}"
