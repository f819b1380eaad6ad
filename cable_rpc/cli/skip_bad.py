"""The option ``--skip-bad`` and what is said of it at a command's end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from cable_rpc.data.bad_frames import BadFrames

SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Leave damaged frames and label rows out, and list them.")]

SHOWN_DAMAGE = 10


@contextmanager
def bad_frames_listed(skip: bool) -> Iterator[BadFrames]:
    """Gives what decides about damage, and prints what was skipped when the block ends, however it does."""
    bad_frames = BadFrames(skip=skip)
    try:
        yield bad_frames
    finally:
        for line in skipped_lines(bad_frames.skipped):
            print(line)


def skipped_lines(skipped: list[str]) -> list[str]:
    """What was skipped, as a list for a terminal."""
    lines = [f"skipped: {line}" for line in skipped[:SHOWN_DAMAGE]]
    if len(skipped) > SHOWN_DAMAGE:
        lines.append(f"skipped: {len(skipped) - SHOWN_DAMAGE} more, each in the log on stderr")
    return lines
