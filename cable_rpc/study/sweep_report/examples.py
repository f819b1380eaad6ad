"""Received pictures of a sweep beside each other at nearly equal bit rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cable_rpc.study.report_page import jpeg_uri
from cable_rpc.study.sweep.cell import CellResult, MeasuredCell
from cable_rpc.study.sweep.qualities import QUALITIES
from cable_rpc.study.sweep_report.facts import facts_of
from cable_rpc.study.sweep_report.methods import is_repeated

NEARLY_EQUAL = 0.15
"""Rates that differ by no more are called equal."""
MOST_PICTURES = 60
MOST_BYTES = 4_500_000
"""Of pictures in one page, before base64."""


@dataclass(frozen=True, slots=True)
class Example:
    """One picture with its caption."""

    method: str
    uri: str
    caption: str
    off_rate: str
    """How far its rate is from the row's, e.g. "+32 % bit rate"; empty where it is nearly equal."""


@dataclass(frozen=True, slots=True)
class ExampleRow:
    """One sequence at one bit rate."""

    sequence: str
    rate_kbps: float
    examples: tuple[Example, ...]


@dataclass(frozen=True, slots=True)
class ExampleRows:
    """What the page shows, and how many sequences it left out."""

    rows: tuple[ExampleRow, ...]
    left_out: int


def example_rows(methods: Mapping[str, Sequence[MeasuredCell]], anchors: Sequence[str]) -> ExampleRows:
    """A row for each sequence, up to the page's limits.

    Args:
        methods: measured cells by label.
        anchors: labels of the anchors, of which the first that has the sequence sets its bit rate.
    """
    pictured = [
        (cell, cell.result)
        for cells in methods.values()
        for cell in cells
        if cell.example and cell.result is not None and not is_repeated(cell.cell)
    ]
    sequences = tuple(dict.fromkeys(result.sequence for _, result in pictured))
    rows: list[ExampleRow] = []
    pictures = size = 0
    for name in sequences:
        own: dict[str, list[MeasuredCell]] = {}
        for cell, result in pictured:
            if result.sequence == name:
                own.setdefault(cell.cell.method, []).append(cell)
        rate = common_rate(own, anchors)
        chosen = [min(cells, key=lambda cell: distance(cell, rate)) for cells in own.values()]
        pictures += len(chosen)
        size += sum(len(cell.example.picture) for cell in chosen if cell.example)
        if rows and (pictures > MOST_PICTURES or size > MOST_BYTES):
            break
        rows.append(ExampleRow(name, rate, tuple(example_of(cell, rate) for cell in chosen[:MOST_PICTURES])))
    return ExampleRows(tuple(rows), len(sequences) - len(rows))


def common_rate(cells: Mapping[str, Sequence[MeasuredCell]], anchors: Sequence[str]) -> float:
    """The rate of the anchor's cell beside which most methods have one of nearly equal rate; of several the middle."""
    label = next((label for label in anchors if label in cells), next(iter(cells)))

    def company(rate: float) -> int:
        return sum(any(distance(cell, rate) <= math.log(1 + NEARLY_EQUAL) for cell in own) for own in cells.values())

    rates = sorted(facts_of([cell]).rate_kbps for cell in cells[label])
    most = max(map(company, rates))
    best = [rate for rate in rates if company(rate) == most]
    return best[(len(best) - 1) // 2]


def distance(cell: MeasuredCell, rate_kbps: float) -> float:
    """Of rates on a logarithmic scale."""
    rate = facts_of([cell]).rate_kbps
    return abs(math.log(rate / rate_kbps)) if rate > 0 and rate_kbps > 0 else math.inf


def example_of(measured: MeasuredCell, rate_kbps: float) -> Example:
    """A cell's picture."""
    own = facts_of([measured]).rate_kbps
    near = distance(measured, rate_kbps) <= math.log(1 + NEARLY_EQUAL)
    off = "" if near or rate_kbps <= 0 else f"{100 * (own / rate_kbps - 1):+.0f} % bit rate"
    parts = [measured.cell.setting, f"{own:.0f} kbit/s"]
    parts += [] if measured.result is None else kept_text(measured.result)
    uri = ""
    if measured.example is not None:
        uri = jpeg_uri(measured.example.picture)
        parts.append(f"frame {measured.example.index}: {measured.example.message_bytes:,} bytes".replace(",", "\u00a0"))
    return Example(measured.cell.method, uri, ", ".join(parts), off)


def kept_text(result: CellResult) -> list[str]:
    """The share of detections kept, where there were any."""
    kept = QUALITIES["retention"].value(result)
    return [] if kept is None else [f"{kept:.1f} % kept"]
