"""The images of one sequence in their order, and their times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.coco.images import NS_PER_S, ImageRow, image_row, natural_key, sequence_of
from cable_rpc.data.coco.tables import CocoTables
from cable_rpc.data.json_fields import Identifier, shown
from cable_rpc.errors import SourceError


def read_images(tables: CocoTables, sequence: str, bad_frames: BadFrames) -> list[ImageRow]:
    """The images of a sequence in their order, damaged rows left out.

    Raises:
        SourceError: a row is damaged, unless that is to be skipped.
    """
    rows: list[ImageRow] = []
    for index, row in enumerate(tables.images):
        if sequence_of(tables, row) != sequence:
            continue
        try:
            rows.append(image_row(row, tables.place("images", index)))
        except SourceError as error:
            bad_frames.found(error)
    return in_order(without_repeats(rows, bad_frames), bad_frames)


def without_repeats(rows: Sequence[ImageRow], bad_frames: BadFrames) -> list[ImageRow]:
    """Rows whose id is their own.

    Raises:
        SourceError: two images share an id, unless that is to be skipped.
    """
    seen: dict[Identifier, ImageRow] = {}
    for row in rows:
        earlier = seen.setdefault(row.image_id, row)
        if earlier is not row:
            bad_frames.found(SourceError(f"{row.place}: id {shown(row.image_id)} is that of {earlier.file_name} too"))
    return list(seen.values())


def in_order(rows: Sequence[ImageRow], bad_frames: BadFrames) -> list[ImageRow]:
    """Rows by their number, else by their time, else by the natural order of their names.

    Raises:
        SourceError: two images have one number, or times run backwards along the numbers, unless that is to be skipped.
    """
    if all(row.number is not None for row in rows):
        ordered = sorted(rows, key=lambda row: row.number or 0)
    elif all(row.time_ns is not None for row in rows):
        ordered = sorted(rows, key=lambda row: row.time_ns or 0)
    else:
        return sorted(rows, key=lambda row: natural_key(row.file_name))
    return rising(ordered, bad_frames)


def rising(rows: Iterable[ImageRow], bad_frames: BadFrames) -> list[ImageRow]:
    """Rows of which each comes after the one before by number and by time, as far as both have them.

    Raises:
        SourceError: one doesn't, unless that is to be skipped.
    """
    kept: list[ImageRow] = []
    for row in rows:
        before = kept[-1] if kept else None
        if before is not None:
            numbers_rise = row.number is None or before.number is None or row.number > before.number
            times_rise = row.time_ns is None or before.time_ns is None or row.time_ns > before.time_ns
            if not (numbers_rise and times_rise):
                told = f"number {row.number}" if not numbers_rise else f"time {row.time_ns} ns"
                was = before.number if not numbers_rise else f"{before.time_ns} ns"
                bad_frames.found(
                    SourceError(
                        f"{row.place}: {told} doesn't rise above {was} of {before.file_name}; frames need an order"
                    )
                )
                continue
        kept.append(row)
    return kept


def times_ns(rows: Sequence[ImageRow], fps: float) -> list[int]:
    """Capture times of ordered rows: their own where all have one, else by number or place at ``fps`` from 0 on."""
    if all(row.time_ns is not None for row in rows):
        return [row.time_ns or 0 for row in rows]
    if all(row.number is not None for row in rows):
        first = rows[0].number or 0
        return [round(((row.number or 0) - first) * NS_PER_S / fps) for row in rows]
    return [round(place * NS_PER_S / fps) for place in range(len(rows))]
