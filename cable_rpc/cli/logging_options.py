"""How a long-running command logs: options and what they set up."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import typer

from cable_rpc.structured_log import LogFormat, configure_logging

PANEL = "Operations"
log = logging.getLogger("cable_rpc")


class LogLevel(StrEnum):
    """Entries below are left out."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


LogFormatOption = Annotated[
    LogFormat,
    typer.Option(
        "--log-format",
        help="text: lines for people | json: one object a line on stderr, with stream, client and identity as fields; "
        "what is printed otherwise becomes entries too.",
        rich_help_panel=PANEL,
    ),
]
LogLevelOption = Annotated[
    LogLevel | None,
    typer.Option(
        "--log-level",
        help="Entries below are left out; warning for text (info after -v), info for JSON.",
        rich_help_panel=PANEL,
    ),
]


@dataclass(frozen=True, slots=True)
class Voice:
    """Where lines for people go that are no log entries."""

    announce: Callable[[str], None]
    warn: Callable[[str], None]


def set_up_logging(form: LogFormat, level: LogLevel | None) -> Voice:
    """Makes the process log as asked.

    Args:
        form: text or JSON.
        level: None = what suits the form.

    Returns:
        Prints on stdout and stderr; with JSON, makes entries of all.
    """
    as_json = form is LogFormat.JSON
    usual = logging.INFO if as_json else logging.getLogger().level
    configure_logging(form, usual if level is None else getattr(logging, level.name), sys.stderr)
    if as_json:
        return Voice(lambda line: log.info("%s", line.strip()), lambda line: log.warning("%s", line))
    return Voice(lambda line: print(line, flush=True), lambda line: print(f"cable-rpc: {line}", file=sys.stderr))
