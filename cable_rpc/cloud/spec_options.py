"""Options in a back end's name: ``NAME:ARGUMENT?key=value&key=value``, read into the fields of dataclasses.

What may be given, which values, and what it means are told by the fields themselves: their types, their defaults
and ``metadata["help"]``.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, field, fields
from typing import Any, Literal, get_args, get_origin, get_type_hints
from urllib.parse import parse_qsl

from cable_rpc.errors import ConfigurationError

INTEGERS = tuple[int, ...]


def meaning(text: str, default: Any = None) -> Any:
    """A field with its explanation; without a default, the server's flag or the file decides."""
    return field(default=default, metadata={"help": text})


def read_options(spec: str, query: str, *kinds: type) -> list[dict[str, Any]]:
    """The values of ``key=value&...`` for the fields of one or several dataclasses.

    Args:
        spec: the whole name, for the errors.
        query: what follows its ``?``; percent-encoding is undone.
        kinds: dataclasses with fields of type bool, int, float, str, tuple[int, ...] or Literal, or None too.

    Returns:
        For each dataclass the keyword arguments that were given.

    Raises:
        ConfigurationError: unknown key (lists all with their meanings), a key given twice, or an unusable value.
    """
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        raise ConfigurationError(f"'{spec}': write options as key=value, joined by &") from None
    chosen: list[dict[str, Any]] = [{} for _ in kinds]
    homes = {entry.name: number for number, kind in enumerate(kinds) for entry in fields(kind)}
    for key, text in pairs:
        if key not in homes:
            raise ConfigurationError(f"'{spec}': unknown option '{key}'; known are\n{options_text(*kinds)}")
        values, kind = chosen[homes[key]], kinds[homes[key]]
        if key in values:
            raise ConfigurationError(f"'{spec}': '{key}' is given twice")
        try:
            values[key] = value_of(text, get_type_hints(kind)[key])
        except ValueError as error:
            raise ConfigurationError(f"'{spec}': {key}={text} {error}") from None
    return chosen


def options_text(*kinds: type) -> str:
    """One line for each option: key, values, default and meaning."""
    return "\n".join(option_line(entry, get_type_hints(kind)[entry.name]) for kind in kinds for entry in fields(kind))


def option_line(entry: Field[Any], kind: Any) -> str:
    """One option."""
    shown = ("no", "yes")[entry.default] if isinstance(entry.default, bool) else entry.default
    default = "" if shown in (MISSING, None, "") else f" (default {shown})"
    meaning = entry.metadata.get("help", "")
    return f"  {entry.name}={values_text(kind)}{default}" + (f"  {meaning}" if meaning else "")


def values_text(kind: Any) -> str:
    """What may stand for a type."""
    kind = without_none(kind)
    if get_origin(kind) is Literal:
        return "|".join(str(word) for word in get_args(kind))
    words: Mapping[Any, str] = {bool: "yes|no", int: "INTEGER", float: "NUMBER", INTEGERS: "INTEGER,INTEGER,..."}
    return words.get(kind, "TEXT")


def value_of(text: str, kind: Any) -> Any:
    """A value from its text.

    Raises:
        ValueError: with what may stand there.
    """
    kind = without_none(kind)
    wanted = ValueError(f"can't be read; give {values_text(kind)}")
    if get_origin(kind) is Literal:
        if text not in get_args(kind):
            raise wanted
        return text
    if kind is bool:
        if text not in ("yes", "no"):
            raise wanted
        return text == "yes"
    try:
        return tuple(int(part) for part in text.split(",")) if kind == INTEGERS else kind(text)
    except ValueError:
        raise wanted from None


def without_none(kind: Any) -> Any:
    """``X`` of ``X | None``; any other type as it is."""
    if isinstance(kind, types.UnionType):
        kept = [part for part in get_args(kind) if part is not types.NoneType]
        if len(kept) == 1:
            return kept[0]
    return kind
