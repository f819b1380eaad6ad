"""TFRecord files: uint64 length, its masked CRC-32C, data, the data's masked CRC-32C, all little-endian."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.waymo.crc32c import masked_crc32c
from cable_rpc.errors import SourceError

LENGTH = struct.Struct("<Q")
CRC = struct.Struct("<I")
HEAD_BYTES = LENGTH.size + CRC.size


@dataclass(frozen=True, slots=True)
class RecordSpan:
    """Where the data of a record lies."""

    number: int
    """1, 2, ... in the file."""
    start: int
    length: int


def record_spans(path: Path, bad_frames: BadFrames) -> list[RecordSpan]:
    """The records of a file; only their heads are read.

    Behind a damaged head nothing can be found, so what follows is left out with it.

    Raises:
        SourceError: the file can't be read; or it is cut off or a head is damaged, unless that is to be skipped.
    """
    spans: list[RecordSpan] = []
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            position = 0
            while position < size:
                number = len(spans) + 1
                head = file.read(HEAD_BYTES)
                if len(head) < HEAD_BYTES or masked_crc32c(head[: LENGTH.size]) != CRC.unpack(head[LENGTH.size :])[0]:
                    why = "the checksum of its length is wrong" if len(head) == HEAD_BYTES else "the file ends in it"
                    bad_frames.found(
                        SourceError(f"{path} record {number} at byte {position} and what follows can't be read: {why}")
                    )
                    break
                (length,) = LENGTH.unpack(head[: LENGTH.size])
                start = position + HEAD_BYTES
                position = start + length + CRC.size
                if position > size:
                    bad_frames.found(
                        SourceError(f"{path} record {number} is cut off: {length} bytes, {size - start} are there")
                    )
                    break
                spans.append(RecordSpan(number, start, length))
                file.seek(position)
    except OSError as error:
        raise SourceError(f"can't read {path}: {error.strerror}") from error
    return spans


def read_record(path: Path, span: RecordSpan) -> bytes:
    """The data of a record.

    Raises:
        SourceError: the file can't be read, or the data's checksum is wrong.
    """
    try:
        with path.open("rb") as file:
            file.seek(span.start)
            data = file.read(span.length)
            stored = file.read(CRC.size)
    except OSError as error:
        raise SourceError(f"can't read {path}: {error.strerror}") from error
    if len(stored) < CRC.size or masked_crc32c(data) != CRC.unpack(stored)[0]:
        raise SourceError(f"{path} record {span.number}: the checksum of its data is wrong; copy the file anew")
    return data


def write_records(path: Path, records: Iterable[bytes]) -> None:
    """Write a file."""
    with path.open("wb") as file:
        for data in records:
            length = LENGTH.pack(len(data))
            file.write(length + CRC.pack(masked_crc32c(length)))
            file.write(data)
            file.write(CRC.pack(masked_crc32c(data)))
