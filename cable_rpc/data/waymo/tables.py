"""Parquet tables, read a few rows and only the columns needed at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from cable_rpc.errors import ConfigurationError, SourceError

BUFFER_BYTES = 1 << 20
"""Read ahead per column; without it a whole row group's images would be held. A page or a dictionary, the least that
Parquet can unpack, is held whole in any case."""
BATCH_ROWS = 16


@dataclass(frozen=True, slots=True)
class TableBatch:
    """Neighbouring rows of one row group."""

    row_group: int
    offset: int
    """Of the first row within its group."""
    columns: Mapping[str, Any]
    """Column name to a ``pyarrow.Array``."""


def arrow_modules(path: Path) -> tuple[Any, Any]:
    """``pyarrow`` and ``pyarrow.parquet``, loaded when a table is first touched.

    Args:
        path: the table that needs them, for the error text.

    Raises:
        ConfigurationError: they aren't installed.
    """
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise ConfigurationError(
            f"{path} is a Parquet table, which needs pyarrow; install it with: pip install 'cable-rpc[study]'"
        ) from None


@contextmanager
def parquet_file(path: Path) -> Iterator[Any]:
    """An open ``pyarrow.parquet.ParquetFile``; what goes wrong while it is used is told as damage of the file.

    Raises:
        ConfigurationError: pyarrow isn't installed.
        SourceError: the file can't be read or is damaged.
    """
    arrow, parquet = arrow_modules(path)
    try:
        with parquet.ParquetFile(path, buffer_size=BUFFER_BYTES, pre_buffer=False) as file:
            yield file
    except (arrow.ArrowException, OSError) as error:
        raise SourceError(f"{path} can't be read as a Parquet table: {error}") from error


def require_columns(path: Path, present: Sequence[str], required: Sequence[str]) -> None:
    """Refuse a table that lacks columns.

    Raises:
        SourceError: naming those that are missing and those that are there.
    """
    missing = [name for name in required if name not in present]
    if missing:
        raise SourceError(f"{path} has no column {', '.join(missing)}; found {', '.join(present)}")


def read_columns(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
    """Small columns as lists, one value or None per row; columns that may be missing are None throughout then.

    Raises:
        SourceError: the file can't be read, or a column is missing.
    """
    with parquet_file(path) as file:
        present = file.schema_arrow.names
        require_columns(path, present, required)
        table = file.read(columns=[*required, *(name for name in optional if name in present)])
        columns: dict[str, list[Any]] = table.to_pydict()
        return columns | {name: [None] * table.num_rows for name in optional if name not in columns}


def row_group_sizes(path: Path) -> list[int]:
    """Rows of each row group.

    Raises:
        SourceError: the file can't be read.
    """
    with parquet_file(path) as file:
        return [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]


def read_batches(
    path: Path, required: Sequence[str], optional: Sequence[str], row_groups: Sequence[int]
) -> Iterator[TableBatch]:
    """Some columns of some row groups, a few rows at a time; optional columns are left out where there are none.

    Raises:
        SourceError: the file can't be read, or a column is missing.
    """
    with parquet_file(path) as file:
        present = file.schema_arrow.names
        require_columns(path, present, required)
        columns = [*required, *(name for name in optional if name in present)]
        for group in row_groups:
            offset = 0
            for batch in file.iter_batches(BATCH_ROWS, row_groups=[group], columns=columns):
                yield TableBatch(group, offset, dict(zip(batch.schema.names, batch.columns, strict=True)))
                offset += batch.num_rows
