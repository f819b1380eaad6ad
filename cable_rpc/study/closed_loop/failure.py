"""What a failed measurement tells."""

from __future__ import annotations

import logging

from cable_codecs import CodecError

from cable_rpc.errors import CableError

log = logging.getLogger(__name__)


def told(failure: Exception) -> str:
    """An error as one line; the trace of one that nobody raised on purpose goes to the log."""
    if isinstance(failure, (CableError, CodecError)):
        return str(failure)
    log.error("a cell failed", exc_info=failure)
    return f"{type(failure).__name__}: {failure}"
