"""Costs of cells that are looked at together: bytes, pixels, frames, times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cable_rpc.study.metrics import percentiles
from cable_rpc.study.sweep.cell import ANCHOR_STRATEGY, MeasuredCell, SweepCell, UplinkBytes
from cable_rpc.study.sweep_report.methods import is_repeated

KEY_LETTERS = 10
"""Of a cell's key, enough to find it."""


@dataclass(frozen=True, slots=True)
class CellFacts:
    """Costs of one cell or of several."""

    frames: int
    dropped: int
    seconds: float
    uplink: UplinkBytes
    pixel_saving: float | None
    """1 - share of the pixels that were sent, mean over frames."""
    p95_ms: float | None
    """95th percentile of the answered frames' end-to-end times; None where there is none."""
    keys: tuple[str, ...]
    """Beginnings of the cells' keys."""

    @property
    def rate_kbps(self) -> float:
        """Of all bytes up."""
        return self.uplink.total * 8e-3 / self.seconds

    @property
    def key_text(self) -> str:
        """For people; the first of many."""
        more = len(self.keys) - 1
        return "" if not self.keys else self.keys[0] if not more else f"{self.keys[0]} and {more} more"


def facts_of(cells: Sequence[MeasuredCell]) -> CellFacts:
    """Sums over measured cells, of which there is at least one."""
    results = [measured.result for measured in cells if measured.result is not None]
    uplink = UplinkBytes()
    for result in results:
        uplink += result.uplink
    covered = sum(result.metrics.coverage_tx.coverage for result in results)
    frames = sum(result.metrics.coverage_tx.frames for result in results)
    times = percentiles(ns / 1e6 for result in results for ns in result.metrics.end_to_end_ns)
    return CellFacts(
        frames=sum(result.metrics.frames for result in results),
        dropped=sum(result.dropped for result in results),
        seconds=sum(result.seconds for result in results),
        uplink=uplink,
        pixel_saving=1.0 - covered / frames if frames else None,
        p95_ms=times.p95 if times else None,
        keys=tuple(measured.key[:KEY_LETTERS] for measured in cells if measured.key),
    )


def settings_facts(cells: Sequence[MeasuredCell]) -> dict[str, CellFacts]:
    """Facts of a method by setting, in the order of the cells, over all its sequences."""
    grouped: dict[str, list[MeasuredCell]] = {}
    for measured in cells:
        grouped.setdefault(measured.cell.setting, []).append(measured)
    return {setting: facts_of(members) for setting, members in grouped.items()}


def byte_savings(methods: Mapping[str, Sequence[MeasuredCell]]) -> list[tuple[MeasuredCell, float]]:
    """Each cell with its saving of bytes against the same frames sent whole by the same codec at the same setting.

    Left out: whole frames themselves, cells at a target bit rate (which is what they cost) or a reduced upload (whose
    pixels are others), and those whose whole frames weren't measured.
    """
    cells = [measured for members in methods.values() for measured in members]
    whole = {
        like_key(measured.cell): facts_of([measured]).uplink.total
        for measured in cells
        if measured.cell.strategy == ANCHOR_STRATEGY and is_plain(measured.cell)
    }
    savings = []
    for measured in cells:
        total = whole.get(like_key(measured.cell))
        if is_repeated(measured.cell) or measured.cell.treatment.scale != 1.0:
            continue
        if measured.cell.strategy != ANCHOR_STRATEGY and measured.cell.rate.bitrate_kbps is None and total:
            savings.append((measured, 1.0 - facts_of([measured]).uplink.total / total))
    return savings


def is_plain(cell: SweepCell) -> bool:
    """Whether frames are sent at full size and without a link that drops some."""
    return cell.treatment.scale == 1.0 and cell.link is None and cell.feedback_delay == 1


def like_key(cell: SweepCell) -> tuple[object, ...]:
    """What two cells must share for their bytes to be compared at equal setting."""
    return (cell.clip, cell.codec, cell.rate)
