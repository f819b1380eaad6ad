"""JSON files that are read whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cable_rpc.errors import SourceError


def read_json(path: Path, kind: str, object_hook: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """What a file holds.

    Args:
        path: the file.
        kind: what it is, for error texts.
        object_hook: takes each object as it is parsed and gives what is kept in its place.

    Raises:
        SourceError: it can't be read, or isn't JSON.
    """
    try:
        with path.open("rb") as file:
            return json.load(file, object_hook=object_hook)
    except OSError as error:
        raise SourceError(f"can't read {kind} {path}: {error.strerror}") from error
    except json.JSONDecodeError as error:
        raise SourceError(f"{path} line {error.lineno}, column {error.colno} is not JSON: {error.msg}") from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise SourceError(f"{path} is not JSON: {error}") from error
