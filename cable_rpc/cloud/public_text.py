"""What may be said outside: no paths of this machine, no control characters, nothing endless."""

from __future__ import annotations

import re

MOST_CHARACTERS = 600
ABSOLUTE_PATH = re.compile(r"(?<![\w/.])(?:~|[A-Za-z]:)?[/\\](?:[^\s'\":,;()]+[/\\])+([^\s'\":,;()]*)")
"""Two parts at least; what follows the last separator stays."""


def public_text(text: str) -> str:
    """A text for the peer: of absolute paths the last part stays, unprintable characters become spaces, and it is cut
    to 600 characters."""
    printable = "".join(letter if letter.isprintable() else " " for letter in text)
    shown = ABSOLUTE_PATH.sub(r"\1", printable)
    return shown if len(shown) <= MOST_CHARACTERS else shown[: MOST_CHARACTERS - 1] + "…"


def log_text(text: str) -> str:
    """A text of the peer for our logs: one line, so that it can't pretend to be another entry, and not endless."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:MOST_CHARACTERS])
