"""nuScenes' tables: JSON lists of rows, some of them over a gigabyte, read row by row."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from cable_rpc.data.json_fields import JsonRow, number, shown, text
from cable_rpc.errors import ConfigurationError, SourceError

SITE = "https://www.nuscenes.org/nuscenes#download"
NS_PER_US = 1000
CHUNK_CHARS = 1 << 20
LONGEST_ROW_CHARS = 1 << 20
"""A row that isn't complete after so much text is taken to be broken, not to go on."""
GAP = re.compile(r"[\s,]*")
OPENING = re.compile(r"\ufeff?\s*\[")


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row and where it stands."""

    values: JsonRow
    place: str
    """File and row for error texts; rows are counted from 0, as ``jq '.[3]'`` does."""

    def token(self, key: str = "token") -> str:
        """The token under a key, an empty text where there is none."""
        value = self.values.get(key)
        return value if isinstance(value, str) else ""


@dataclass(slots=True)
class RowReader:
    """Decodes the rows of one table while reading it piece by piece."""

    path: Path
    text: str = ""
    """What is read but not yet passed."""
    at: int = 0
    """Where the next row begins in the text."""
    rows: int = 0
    lines: int = 1
    """Line of the file on which the text begins."""
    ended: bool = False
    decoder: json.JSONDecoder = field(default_factory=json.JSONDecoder)

    def feed(self, chunk: str) -> None:
        """Append what was read; an empty piece is the end of the file."""
        self.lines += self.text.count("\n", 0, self.at)
        self.text = self.text[self.at :] + chunk
        self.at = 0
        self.ended = not chunk

    def complete(self) -> Iterator[TableRow]:
        """Rows as far as the text goes.

        Raises:
            SourceError: the text isn't a list of JSON objects.
        """
        while True:
            gap = GAP.match(self.text, self.at)
            self.at = gap.end() if gap else self.at
            if self.at == len(self.text) or self.text[self.at] == "]":
                return
            try:
                value, end = self.decoder.raw_decode(self.text, self.at)
            except json.JSONDecodeError as error:
                if not self.ended and len(self.text) - self.at < LONGEST_ROW_CHARS:
                    return
                raise self.broken(error.msg, error.pos) from error
            if not isinstance(value, dict):
                raise self.broken(f"{shown(value)} is no object", self.at)
            self.at = end
            yield TableRow(value, f"{self.path} [{self.rows}]")
            self.rows += 1

    def broken(self, what: str, position: int) -> SourceError:
        """The error for damage at a position of the text."""
        line = self.lines + self.text.count("\n", 0, position)
        return SourceError(
            f"{self.path} line {line}, row [{self.rows}]: {what}; the table is damaged or cut off, fetch it again from "
            f"{SITE}"
        )


def read_rows(path: Path) -> Iterator[TableRow]:
    """The rows of a table, one at a time, in constant memory.

    Raises:
        SourceError: the file is missing, no list of JSON objects, or cut off.
    """
    reader = RowReader(path)
    try:
        with path.open(encoding="utf-8") as file:
            reader.feed(file.read(CHUNK_CHARS))
            opening = OPENING.match(reader.text)
            if opening is None:
                raise reader.broken("a table begins with '['", 0)
            reader.at = opening.end()
            while True:
                yield from reader.complete()
                if reader.ended or reader.text[reader.at : reader.at + 1] == "]":
                    break
                reader.feed(file.read(CHUNK_CHARS))
    except FileNotFoundError:
        raise SourceError(f"{path} is missing; the tables are part of the data set's metadata from {SITE}") from None
    except OSError as error:
        raise SourceError(f"can't read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SourceError(f"{path} isn't JSON: {error}") from error
    if reader.text[reader.at : reader.at + 1] != "]":
        raise reader.broken("the closing ']' is missing", len(reader.text))


def names_by_token(path: Path, key: str) -> dict[str, str]:
    """The texts under a key of a small table, by token."""
    return {text(row.values, "token", row.place): text(row.values, key, row.place) for row in read_rows(path)}


def time_of(row: TableRow, key: str = "timestamp") -> int:
    """A time in ns; the tables have microseconds, Lyft's with a fraction.

    Raises:
        SourceError: it is missing or no number.
    """
    value = row.values.get(key)
    if isinstance(value, int) and not isinstance(value, bool):
        return value * NS_PER_US
    return round(number(row.values, key, row.place) * NS_PER_US)


def find_versions(root: Path) -> list[str]:
    """Names of the folders of tables.

    Raises:
        SourceError: there is no such root, or nothing in it is a folder of tables.
    """
    if not root.is_dir():
        raise SourceError(f"no such folder: {root}; nuScenes can be had at {SITE}")
    versions = sorted(table.parent.name for table in root.glob("*/scene.json"))
    if not versions:
        raise SourceError(
            f"{root} holds no v1.0-*/scene.json; give the folder with samples/, sweeps/ and v1.0-* of {SITE}"
        )
    return versions


def tables_folder(root: Path, version: str | None) -> Path:
    """The folder of tables of a version, or of the only one.

    Args:
        root: of the data set, or the folder of tables itself, which lies in that.
        version: name of the folder of tables.

    Raises:
        ConfigurationError: no such version, or several and none is told.
        SourceError: there are none at all.
    """
    if (root / "scene.json").is_file():
        root, versions = root.absolute().parent, [root.absolute().name]
    else:
        versions = find_versions(root)
    if version is None and len(versions) > 1:
        raise ConfigurationError(
            f"{root} holds the versions {', '.join(versions)}; add ?version={versions[0]}, or give {root / versions[0]}"
        )
    if version is not None and version not in versions:
        raise ConfigurationError(f"{root} has no version '{version}'; it holds {', '.join(versions)}")
    return root / (version or versions[0])
