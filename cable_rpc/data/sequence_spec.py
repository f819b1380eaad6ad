"""Specs of data sets, ``ROOT#SEQUENCE?key=value&...``, and the choice of a sequence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from cable_rpc.data.names import listed
from cable_rpc.errors import ConfigurationError, SourceError


@dataclass(frozen=True, slots=True)
class SequenceSpec:
    """A spec taken apart."""

    spec: str
    """As written, for error texts."""
    root: Path
    sequence: str | None
    values: Mapping[str, str]
    """Options after ``?``."""


def parse_sequence_spec(scheme: str, rest: str, known_keys: Sequence[str] = ()) -> SequenceSpec:
    """Take a spec apart.

    Args:
        scheme: of the data set.
        rest: what follows it. Values may be percent-encoded.
        known_keys: of the options that the data set has.

    Raises:
        ConfigurationError: no root is named, or an option is unknown, comes twice or has no value.
    """
    spec = f"{scheme}:{rest}"
    head, _, query = rest.partition("?")
    root, _, sequence = head.partition("#")
    if not root:
        raise ConfigurationError(f"'{spec}' names no file or folder; write {scheme}:ROOT#SEQUENCE")
    values: dict[str, str] = {}
    for pair in query.split("&") if query else []:
        key, _, value = pair.partition("=")
        if key not in known_keys or not value:
            known = f"known are {', '.join(known_keys)}" if known_keys else "there are none for this data set"
            raise ConfigurationError(f"'{spec}': option '{pair}'; write key=value, joined by &; {known}")
        if key in values:
            raise ConfigurationError(f"'{spec}': give {key} once")
        values[key] = unquote(value)
    return SequenceSpec(spec, Path(root), sequence or None, values)


def choose_sequence(spec: SequenceSpec, names: Sequence[str]) -> str:
    """The sequence asked for, or the only one.

    Raises:
        SourceError: there is none at all.
        ConfigurationError: it isn't there, or isn't told and there are several.
    """
    if not names:
        raise SourceError(f"'{spec.spec}': {spec.root} holds no sequence with images")
    if spec.sequence is None:
        if len(names) > 1:
            raise ConfigurationError(f"'{spec.spec}' has {len(names)} sequences; add #SEQUENCE, {listed(names)}")
        return names[0]
    if spec.sequence not in names:
        raise ConfigurationError(f"'{spec.spec}': there is no sequence '{spec.sequence}'; use {listed(names)}")
    return spec.sequence
