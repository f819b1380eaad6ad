"""The exceptions of the codec package."""

from __future__ import annotations

from collections.abc import Sequence


class CodecError(Exception):
    """A frame, mask or parameter can't be coded; the text says what was wrong, where, and what to do."""


class CodecUnavailableError(CodecError):
    """The asked codec or encoder is unknown or can't be opened on this machine."""

    def __init__(
        self, name: str, available: Sequence[str], reason: str = "it is not a known codec", kind: str = "codec"
    ) -> None:
        self.name = name
        self.available = tuple(available)
        listed = ", ".join(self.available) or "none"
        super().__init__(f"{kind} {name!r} can't be used: {reason}; available {kind}s: {listed}")
