"""What becomes of a data set's damaged frames and label rows: an error, or a note and the next one."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from cable_rpc.errors import SourceError

log = logging.getLogger(__name__)


@dataclass(slots=True)
class BadFrames:
    """Decides about damage, and remembers what was skipped.

    A reader that finds a truncated image, a label row that can't be parsed or a frame without its file calls
    `found` in place of raising, and leaves the frame or row out where the call returns.
    """

    skip: bool = False
    skipped: list[str] = field(default_factory=list)
    """What was left out, one line each: file, line where there is one, and what was wrong with it."""

    def found(self, error: SourceError) -> None:
        """Reports damage.

        Raises:
            SourceError: the one given, unless damage is to be skipped.
        """
        if not self.skip:
            raise error
        line = str(error)
        if line not in self.skipped:
            self.skipped.append(line)
            log.warning("skipped: %s", line)
