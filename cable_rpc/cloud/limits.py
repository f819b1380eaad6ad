"""What clients may use, as plain numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from cable_rpc.errors import ConfigurationError

UNLIMITED = math.inf


@dataclass(frozen=True, slots=True)
class IdentityLimits:
    """The share of one identity, all of its streams together."""

    streams: float = UNLIMITED
    frames_per_s: float = UNLIMITED
    pixels_per_s: float = UNLIMITED
    """Of the camera's frames, width x height x rate."""
    bytes_per_s: float = UNLIMITED
    """Of coded frames."""

    def __post_init__(self) -> None:
        for name, value in self.items():
            if not value > 0:
                raise ConfigurationError(f"limit {name} is {value:g}; it must be positive")

    def items(self) -> list[tuple[str, float]]:
        """Names and values."""
        return [(field.name, float(getattr(self, field.name))) for field in fields(self)]


@dataclass(frozen=True, slots=True)
class ServerLimits:
    """What all clients together may use."""

    streams: int = 64
    pixels_per_s: float = UNLIMITED
    """Sum of what the open streams announced in their CodecConfig."""
    identity: IdentityLimits = IdentityLimits()
    """Share of an identity that has none of its own."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a client has proved to be."""

    name: str
    limits: IdentityLimits | None = None
    """Its own share; None = the server's default."""


ANYBODY = Identity("anybody")
"""Every client of a server that asks for no proof."""
