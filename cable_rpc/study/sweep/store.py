"""Where measured cells are kept: one SQLite file for any number of sweeps, one row for each cell."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from cable_codecs import CodecError

from cable_rpc.errors import CableError, ConfigurationError
from cable_rpc.study.sweep.cell import CellResult, ExampleFrame, MeasuredCell
from cable_rpc.study.sweep.cell_settings import CellLabels, cell_from_settings
from cable_rpc.study.sweep.identity import measuring_code

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
BUSY_MS = 30_000
COMPRESSED_FROM = 4096
"""Length in characters from which a JSON text is stored compressed."""
LARGEST_TEXT = 1 << 28
"""Bytes that a compressed text may come to."""

SCHEMA = """
CREATE TABLE cells (
    key TEXT PRIMARY KEY,
    settings NOT NULL,      -- JSON; text, or zlib where it is long
    labels TEXT NOT NULL,   -- JSON: names of treatment, region settings and link, as whoever measured it chose them
    method TEXT NOT NULL,   -- for people, as the next
    title TEXT NOT NULL,
    result,                 -- JSON as settings; NULL where the cell failed
    example_index INTEGER,  -- frame number; NULL without an example, as the next two
    example_bytes INTEGER,  -- what the frame cost to send
    example BLOB,           -- JPEG
    error TEXT NOT NULL,    -- empty where the cell did not fail
    seconds_taken REAL NOT NULL,
    code TEXT NOT NULL,     -- digest of the measuring sources
    written TEXT NOT NULL   -- UTC, ISO 8601
) WITHOUT ROWID
"""
KEEP = """
INSERT INTO cells VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
ON CONFLICT (key) DO UPDATE SET
    settings = excluded.settings, labels = excluded.labels, method = excluded.method, title = excluded.title,
    result = excluded.result, example_index = excluded.example_index, example_bytes = excluded.example_bytes,
    example = excluded.example, error = excluded.error, seconds_taken = excluded.seconds_taken, code = excluded.code,
    written = excluded.written
WHERE excluded.error = '' OR cells.error != ''
"""
READ = """
SELECT settings, labels, result, example_index, example_bytes, example, error, seconds_taken FROM cells WHERE key = ?
"""


class CellStore:
    """Context manager over the file, which is made where there is none.

    A row is there as soon as `keep` returns, and stays there through a kill or a power cut. Sweeps beside each other
    may share a file on a local disk (SQLite's write-ahead log needs shared memory, which network file systems lack).

    Raises:
        ConfigurationError: the file can't be opened or made, is no store of cells, or is one of another schema.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self.complaints("open"):
            self.connection = connect(path)
            try:
                self._prepare()
            except BaseException:
                self.connection.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves one file, without a log beside it."""
        self.connection.close()

    def find(self, key: str) -> MeasuredCell | None:
        """A cell that was measured; None where there is none, or it failed, or its row is damaged.

        The labels are those of the sweep that measured it.

        Raises:
            ConfigurationError: the file can't be read.
        """
        cell = self.read(key)
        return None if cell is None or cell.result is None else cell

    def read(self, key: str) -> MeasuredCell | None:
        """As `find`, and failed cells too."""
        with self.complaints("read"):
            row = self.connection.execute(READ, (key,)).fetchone()
        if row is None:
            return None
        try:
            return cell_of(key, row)
        except (ValueError, KeyError, TypeError, zlib.error, CableError, CodecError) as error:
            log.warning("%s: the row of cell %s is damaged and is not used: %s", self.path, key, error)
            return None

    def keep(self, key: str, measured: MeasuredCell) -> None:
        """Write a cell, failed ones too, for whoever looks for the reason; those never replace a measured one.

        Raises:
            ConfigurationError: the file can't be written to; what it held is still there.
        """
        cell, result, example = measured.cell, measured.result, measured.example
        labels = CellLabels.of(cell)
        row = (
            key,
            packed(cell.settings()),
            json.dumps([labels.treatment, labels.roi, labels.link], ensure_ascii=False),
            cell.method,
            cell.title,
            None if result is None else packed(result.to_json()),
            None if example is None else example.index,
            None if example is None else example.message_bytes,
            None if example is None else example.picture,
            measured.error,
            measured.seconds_taken,
            measuring_code(),
            datetime.now(UTC).isoformat(timespec="seconds"),
        )
        with self.complaints("write"), self.connection:
            self.connection.execute(KEEP, row)

    def keys(self) -> frozenset[str]:
        """Of all cells that were measured."""
        with self.complaints("read"):
            return frozenset(key for (key,) in self.connection.execute("SELECT key FROM cells WHERE error = ''"))

    @contextmanager
    def complaints(self, what: str) -> Iterator[None]:
        """Turns the database's errors into the package's."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            reason = (isinstance(error, OSError) and error.strerror) or error
            raise ConfigurationError(
                f"can't {what} the store of cells {self.path}: {reason}; cells measured so far are kept. Free space or "
                "name another file with --store"
            ) from error

    def _prepare(self) -> None:
        (version,) = self.connection.execute("PRAGMA user_version").fetchone()
        if version == SCHEMA_VERSION:
            return
        (tables,) = self.connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if version != 0 or tables:
            raise ConfigurationError(
                f"{self.path} is no store of cells of schema {SCHEMA_VERSION} (it says {version}); it is left as "
                "it is. Name another file with --store"
            )
        self.connection.execute("PRAGMA journal_mode = WAL")
        # Two that find the file empty at the same time: the second waits, and finds the table.
        self.connection.execute("BEGIN IMMEDIATE")
        (tables,) = self.connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if not tables:
            self.connection.execute(SCHEMA)
            self.connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        self.connection.commit()


def connect(path: Path) -> sqlite3.Connection:
    """Open or make a file; one on a read-only medium is opened as it is.

    Raises:
        sqlite3.Error, OSError: it can't be opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    address = path.absolute().as_uri()
    if path.is_file() and not os.access(path.parent, os.W_OK):
        address += "?mode=ro&immutable=1"
    connection = sqlite3.connect(address, uri=True, timeout=BUSY_MS / 1000)
    try:
        connection.execute("PRAGMA synchronous = FULL")
    except BaseException:
        connection.close()
        raise
    return connection


def cell_of(key: str, row: tuple[Any, ...]) -> MeasuredCell:
    """A row of `READ`.

    Raises:
        KeyError, TypeError, ValueError, zlib.error, CableError, CodecError: it does not hold a cell.
    """
    settings, labels, result, index, message_bytes, picture, error, seconds_taken = row
    return MeasuredCell(
        cell_from_settings(unpacked(settings), CellLabels(*json.loads(labels))),
        None if result is None else CellResult.from_json(unpacked(result)),
        str(error),
        None if picture is None else ExampleFrame(int(index), bytes(picture), int(message_bytes)),
        float(seconds_taken),
        key,
    )


def packed(content: Any) -> str | bytes:
    """Plain JSON values as text, or compressed where that is long."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False)
    return text if len(text) < COMPRESSED_FROM else zlib.compress(text.encode())


def unpacked(stored: str | bytes) -> Any:
    """The inverse of `packed`.

    Raises:
        ValueError, TypeError, zlib.error: it is damaged.
    """
    if isinstance(stored, str):
        return json.loads(stored)
    unzip = zlib.decompressobj()
    text = unzip.decompress(stored, LARGEST_TEXT)
    if not unzip.eof:
        raise ValueError("a compressed text ends early, or never")
    return json.loads(text)
