"""Traces of recorded links: the milliseconds at which a packet could leave."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.simulated_link import TRACE_PACKET_BYTES

LONGEST_TRACE = 100_000
"""Opportunities to deliver; the trace is part of every cell's settings."""
PACKET_KBIT = TRACE_PACKET_BYTES * 8 / 1000
TIME_COLUMN = "Timestamp"
TIME_FORMAT = "%Y.%m.%d_%H.%M.%S"
Parsed = TypeVar("Parsed")


def read_trace(path: Path, column: str | None = None, start_s: float = 0.0, seconds: float = math.inf) -> list[int]:
    """A part of a trace.

    Args:
        path: Mahimahi's format, a line with a time in ms for each packet of `TRACE_PACKET_BYTES` that the link could
            deliver (Netravali et al., "Mahimahi", USENIX ATC 2015); or, where its name ends with ``.csv``, a table with
            a column ``Timestamp`` (``2020.02.27_20.35.57``) and one with a rate in kbit/s, as the 5G data set of Raca
            et al., MMSys 2020, has.
        column: the table's column of rates; its ``UL_bitrate`` is what was used and not what was there.
        start_s: where to begin.
        seconds: length; the trace is repeated from there on.

    Returns:
        Rising times in ms from the beginning of the part.

    Raises:
        ConfigurationError: the file is missing or in no such format, nothing can leave in that part, or too much.
    """
    end_s = start_s + seconds
    if path.suffix.lower() == ".csv":
        if column is None:
            raise ConfigurationError(f"{path} is a table; name its column of kbit/s as 'column', e.g. DL_bitrate")
        rates = table_rates(path, column)
        times = packet_times({second: rate for second, rate in rates.items() if start_s <= second < end_s})
    else:
        times = mahimahi_times(path)
    part = [time - round(start_s * 1000) for time in times if start_s * 1000 <= time < end_s * 1000]
    if not part or part[-1] == 0:
        raise ConfigurationError(
            f"{path}: no packet can leave between {start_s:g} s and {end_s:g} s; choose another part"
        )
    if len(part) > LONGEST_TRACE:
        raise ConfigurationError(
            f"{path}: more than {LONGEST_TRACE} packets could leave; choose a part with 'start_s' and 'seconds'"
        )
    return part


def mahimahi_times(path: Path) -> list[int]:
    """All times of a Mahimahi trace, ms."""

    def parse(lines: Iterable[str]) -> list[int]:
        times: list[int] = []
        for number, line in enumerate(lines, 1):
            if not line.strip().isascii() or not line.strip().isdigit() or (times and int(line) < times[-1]):
                raise ConfigurationError(
                    f"{path}:{number}: {line.strip()[:40]!r} is no time in whole milliseconds, not falling; a Mahimahi "
                    "trace has one for each packet, a table's name must end with .csv"
                )
            times.append(int(line))
        return times

    return parsed_file(path, parse)


def table_rates(path: Path, column: str) -> dict[float, float]:
    """Rates of a table in kbit/s by their time in s from the first row on; rows of one time stamp are averaged."""

    def parse(lines: Iterable[str]) -> dict[float, float]:
        rows = csv.DictReader(lines)
        names = rows.fieldnames or []
        for name in (TIME_COLUMN, column):
            if name not in names:
                raise ConfigurationError(f"{path}:1: there is no column '{name}'; there are {', '.join(names)}")
        rates: dict[float, list[float]] = {}
        for row in rows:
            try:
                second = datetime.strptime(row[TIME_COLUMN], TIME_FORMAT).replace(tzinfo=UTC).timestamp()
                rate = float(row[column])
            except (TypeError, ValueError):
                raise ConfigurationError(
                    f"{path}:{rows.line_num}: '{row[TIME_COLUMN]}' and '{row[column]}' are no time stamp and rate; "
                    "leave out the row"
                ) from None
            if not 0 <= rate < math.inf or (rates and second < next(reversed(rates))):
                raise ConfigurationError(f"{path}:{rows.line_num}: rates must be at least 0, and times must not fall")
            rates.setdefault(second, []).append(rate)
        first = next(iter(rates), 0.0)
        return {second - first: sum(values) / len(values) for second, values in rates.items()}

    return parsed_file(path, parse)


def packet_times(rates: Mapping[float, float]) -> list[int]:
    """When packets leave, ms; stops soon after `LONGEST_TRACE`.

    Args:
        rates: kbit/s by time in s; each holds until the next one's time, the last for a second.
    """
    starts = list(rates)
    times: list[int] = []
    waiting_kbit = 0.0
    for start, end in zip(starts, [*starts[1:], starts[-1] + 1] if starts else [], strict=True):
        total, sent = rates[start] * (end - start), 0.0
        while total - sent >= PACKET_KBIT - waiting_kbit and len(times) <= LONGEST_TRACE:
            sent += PACKET_KBIT - waiting_kbit
            waiting_kbit = 0.0
            times.append(math.floor((start + sent / rates[start]) * 1000))
        waiting_kbit += total - sent
    return times


def parsed_file(path: Path, parse: Callable[[Iterable[str]], Parsed]) -> Parsed:
    """What a text file's lines hold."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return parse(file)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"can't read the trace {path}: {reason}; paths start at the working folder") from error
