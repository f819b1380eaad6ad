"""A cluster's configuration as plain data: what `serve --engine ray` and a Serve config file give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from cable_rpc.cloud.limits import IdentityLimits, ServerLimits
from cable_rpc.cloud.model_settings import ModelSettings
from cable_rpc.cloud.session_limits import SessionLimits
from cable_rpc.errors import ConfigurationError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ReplicaSettings:
    """How many replicas there are of something, and what each takes."""

    replicas: int = 1
    """With max_replicas: the smallest number."""
    max_replicas: int | None = None
    """Autoscaling between both numbers; None = a fixed number, which suits trials better."""
    cpus: float = 1.0
    gpus: float = 0.0
    """A share of a GPU lets several replicas sit on it."""

    def __post_init__(self) -> None:
        if self.replicas < 1 or (self.max_replicas is not None and self.max_replicas < self.replicas):
            raise ConfigurationError(f"replicas must be 1 or more and max_replicas not fewer, got {self}")
        if not self.cpus > 0 or self.gpus < 0:
            raise ConfigurationError(f"a replica needs some cpus, and gpus of 0 or more, got {self}")


@dataclass(frozen=True, slots=True)
class ClusterSettings:
    """The whole application."""

    models: ModelSettings = field(default_factory=ModelSettings)
    ingress: ReplicaSettings = field(default_factory=ReplicaSettings)
    """Replicas that hold sessions; both models are in each unless they have deployments of their own."""
    detector: ReplicaSettings | None = None
    """The detector in replicas of its own; None = in every ingress replica."""
    segmenter: ReplicaSettings | None = None
    """The segmenter in replicas of its own; None = in every ingress replica."""
    streams: int = 16
    """Sessions of one ingress replica; more wait, unanswered, for a place."""
    pixels_per_s: float = 0.0
    """Of one ingress replica's sessions together; 0 = no limit."""
    max_in_flight: int = 2
    max_frame_bytes: int = 2 << 20
    tokens: str = ""
    """File of who may come, at that path on every node; empty = everybody who can connect."""
    resume_window_s: float = 30.0
    """How long a replica keeps a session whose stream broke; another replica begins anew, with a keyframe."""
    drain_s: float = 10.0
    """How long a replica that is to stop goes on with its sessions."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> ClusterSettings:
        """From a configuration file's nested mappings.

        Raises:
            ConfigurationError: an unknown key, or a value of the wrong kind.
        """
        return _read(cls, values, "args")

    @property
    def limits(self) -> SessionLimits:
        """Of one session."""
        return SessionLimits(
            max_in_flight=self.max_in_flight,
            max_frame_bytes=self.max_frame_bytes,
            default_min_score=self.models.min_score,
            latency_bound_s=self.models.latency_bound_s,
        )

    @property
    def shares(self) -> ServerLimits:
        """Of one ingress replica."""
        unlimited = ServerLimits()
        return ServerLimits(self.streams, self.pixels_per_s or unlimited.pixels_per_s, IdentityLimits())

    @property
    def tokens_path(self) -> Path | None:
        """Where the tokens are."""
        return Path(self.tokens) if self.tokens else None


def _read(kind: type[T], values: Any, where: str) -> T:
    if not isinstance(values, Mapping):
        raise ConfigurationError(f"{where}: expected keys and values, got {values!r}")
    hints = get_type_hints(kind)
    known = {one.name for one in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigurationError(f"{where}: unknown {', '.join(unknown)}; known are {', '.join(sorted(known))}")
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if value is None and type(None) in kinds:
        return None
    kind = next(one for one in kinds if one is not type(None))
    if hasattr(kind, "__dataclass_fields__"):
        return _read(kind, value, where)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ConfigurationError(f"{where}: expected {kind.__name__}, got {value!r}")
    return value
