"""Annotation files in COCO's JSON format, as tables of rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cable_rpc.data.json_fields import Identifier, JsonRow, identifier, shown, text
from cable_rpc.data.json_file import read_json
from cable_rpc.errors import SourceError

UNREAD_KEYS = ("segmentation", "caption", "keypoints", "counts")
"""What most annotation files are full of, dropped while parsing: it would be nearly all of the memory."""


@dataclass(frozen=True, slots=True)
class CocoTables:
    """The rows of one annotation file. They hold whatever the file holds; who reads a row checks it."""

    path: Path
    images: list[JsonRow]
    annotations: list[JsonRow] | None
    """None where the file has no such table: a test set."""
    category_names: Mapping[Identifier, str]
    videos: Mapping[Identifier, JsonRow]

    def place(self, table: str, row: int) -> str:
        """Where a row stands, for error texts; rows are counted from 0, as ``jq '.images[3]'`` does."""
        return f"{self.path} {table}[{row}]"


def read_tables(path: Path) -> CocoTables:
    """Read an annotation file.

    Raises:
        SourceError: it can't be read, isn't JSON, or lacks the tables of the format.
    """
    document = read_json(path, "annotation file", without_unread)
    if not isinstance(document, dict):
        raise SourceError(f"{path} holds {shown(document)}; COCO's format is an object with 'images'")
    annotations = table(path, document, "annotations") if "annotations" in document else None
    if annotations and "categories" not in document:
        raise SourceError(f"{path} has annotations but no 'categories' that would name them")
    return CocoTables(
        path,
        table(path, document, "images"),
        annotations,
        category_names(path, document),
        video_rows(path, document),
    )


def without_unread(row: dict[str, Any]) -> dict[str, Any]:
    """A JSON object without what no reader asks for."""
    for key in UNREAD_KEYS:
        row.pop(key, None)
    return row


def table(path: Path, document: JsonRow, name: str) -> list[JsonRow]:
    """One table of a document.

    Raises:
        SourceError: it is missing, or no list of objects.
    """
    rows = document.get(name)
    if not isinstance(rows, list):
        found = ", ".join(sorted(map(str, document))[:10]) or "nothing"
        raise SourceError(f"{path} has no list '{name}' as COCO's format has; found {found}")
    for index, row in enumerate(rows):
        if not isinstance(row, dict):
            raise SourceError(f"{path} {name}[{index}] is {shown(row)}; it must be an object")
    return rows


def category_names(path: Path, document: JsonRow) -> dict[Identifier, str]:
    """Category id to name.

    Raises:
        SourceError: a category lacks one of both.
    """
    rows = table(path, document, "categories") if "categories" in document else []
    names: dict[Identifier, str] = {}
    for index, row in enumerate(rows):
        place = f"{path} categories[{index}]"
        names[identifier(row, "id", place)] = text(row, "name", place)
    return names


def video_rows(path: Path, document: JsonRow) -> dict[Identifier, JsonRow]:
    """Video id to its row, where the file has videos (COCO-VID, TAO).

    Raises:
        SourceError: a video has no id.
    """
    rows = table(path, document, "videos") if "videos" in document else []
    return {identifier(row, "id", f"{path} videos[{index}]"): row for index, row in enumerate(rows)}
