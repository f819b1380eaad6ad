"""Names of sequences, in file names and in error texts."""

from __future__ import annotations

import re
from collections.abc import Sequence

LISTED_NAMES = 10


def safe_name(sequence: str) -> str:
    """A sequence's name as a part of file names."""
    return re.sub(r"[^\w.+-]+", "-", sequence).strip("-.") or "sequence"


def listed(names: Sequence[str]) -> str:
    """Some names for an error text."""
    text = "one of " + ", ".join(f"'{name}'" for name in names[:LISTED_NAMES])
    return text if len(names) <= LISTED_NAMES else f"{text} and {len(names) - LISTED_NAMES} more"
