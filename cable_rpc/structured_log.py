"""Log entries as lines of text or of JSON, with the stream that they belong to.

One entry is one line in either form, whatever a message holds: what strangers send can't pretend to be an entry of its
own. Only the text form has tracebacks on lines of their own, all of them indented.
"""

from __future__ import annotations

import json
import logging
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, TextIO

LONGEST_FIELD = 600


class LogFormat(StrEnum):
    """How entries are written."""

    TEXT = "text"
    JSON = "json"


@dataclass(slots=True)
class StreamLabels:
    """Whose entries they are; the client's name is added when it has introduced itself."""

    stream: str
    """Session id, as the client is told it in Welcome."""
    identity: str
    """Name in the list of tokens or in the certificate."""
    client: str = ""
    """As the client calls itself."""


current_stream: ContextVar[StreamLabels | None] = ContextVar("current_stream", default=None)
"""Set where a session begins; its tasks and those that they start inherit it."""


def label_stream(stream: str, identity: str) -> None:
    """Names the stream to which the entries of this task, and of tasks begun by it, belong."""
    current_stream.set(StreamLabels(stream, identity))


def label_client(stream: str, client: str) -> None:
    """Completes the labels, for the stream's other tasks too: the client has said who it is, and what it resumes."""
    labels = current_stream.get()
    if labels is not None:
        labels.stream, labels.client = stream, client[:LONGEST_FIELD]


def printable(text: str) -> str:
    """The text with a question mark for each character that can't be shown on a line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


class TextFormatter(logging.Formatter):
    """``TIME LEVEL LOGGER: MESSAGE``; a traceback follows, indented."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - its name in logging
        """See `logging.Formatter`; unprintable characters are shown as ``?``."""
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """See `logging.Formatter`."""
        # str.splitlines also knows the separators that some viewers break lines at.
        return "\n".join(f"    {printable(line)}" for line in super().formatException(ei).splitlines())


class JsonFormatter(logging.Formatter):
    """One JSON object a line, in ASCII.

    Fields: ``time`` (RFC 3339, UTC, microseconds), ``level``, ``logger``, ``message``; of a stream ``stream``,
    ``identity`` and ``client``; ``exception`` with the traceback where there is one.
    """

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter`."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="microseconds")
        fields = {
            "time": time.replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        labels = current_stream.get()
        if labels is not None:
            fields |= {"stream": labels.stream, "identity": labels.identity, "client": labels.client}
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        if record.stack_info:
            fields["stack"] = self.formatStack(record.stack_info)
        return json.dumps(fields)


def configure_logging(form: LogFormat, level: int, stream: TextIO) -> None:
    """Sends the entries of this process there, in place of where they went before.

    Args:
        form: text or JSON.
        level: entries below are left out, as in `logging`.
        stream: where to.
    """
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter() if form is LogFormat.JSON else TextFormatter())
    logging.basicConfig(level=level, handlers=[handler], force=True)
