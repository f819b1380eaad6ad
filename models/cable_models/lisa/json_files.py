"""JSON objects beside a checkpoint's tensors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cable_models.errors import ModelError


def read_json(path: Path) -> dict[str, Any] | None:
    """Read a JSON object; None if there is no such file.

    Raises:
        ModelError: The file isn't readable as a JSON object.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ModelError(f"{path} can't be read: {error}") from error
    if not isinstance(content, dict):
        raise ModelError(f"{path} must hold a JSON object, it holds {type(content).__name__}")
    return content


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON object, indented as configurations are."""
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
