"""A YAML document taken apart key by key: every error says in which file, line and key, and what is allowed."""

from __future__ import annotations

import difflib
import math
import reprlib
import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from cable_rpc.errors import ConfigurationError

brief = reprlib.Repr()
brief.maxlevel, brief.maxstring, brief.maxother = 2, 60, 60


@dataclass(frozen=True, slots=True)
class Document:
    """Where a document came from."""

    where: str
    """Its file, for people."""
    lines: Mapping[str, int]
    """Path of a key or item, as in ``grids[0].codecs``, to its line from 1 on."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A value of a document, and where it stands."""

    document: Document
    path: str
    """As in ``grids[0].codecs``; empty for the whole document."""
    value: Any

    def error(self, text: str) -> ConfigurationError:
        """An error about this entry, to be raised."""
        line = self.document.lines.get(self.path)
        place = self.document.where if line is None else f"{self.document.where}:{line}"
        return ConfigurationError(f"{place}: {self.path or 'the document'} {text}")

    def unfit(self, allowed: str) -> ConfigurationError:
        """An error that tells the value and what is allowed instead, to be raised."""
        return self.error(f"is {brief.repr(self.value)}; give {allowed}")

    def mapping(self, known: Collection[str] | None = None) -> dict[str, Entry]:
        """What stands below each key; nothing below an empty value.

        Args:
            known: the keys that there are; None lets all pass.
        """
        if self.value is None:
            return {}
        if not isinstance(self.value, dict):
            raise self.unfit("keys and values" if known is None else f"some of the keys {', '.join(known)}")
        found = {}
        for key, value in self.value.items():
            if not isinstance(key, str):
                raise self.error(f"has the key {brief.repr(key)}, which YAML takes for no text; put it in quotes")
            entry = Entry(self.document, f"{self.path}.{key}" if self.path else key, value)
            if known is not None and key not in known:
                near = difflib.get_close_matches(key, known, 1)
                hint = f"did you mean {near[0]}? " if near else ""
                raise entry.error(f"is unknown; {hint}known are {', '.join(known)}")
            found[key] = entry
        return found

    def items(self) -> Iterator[Entry]:
        """The items of a list; a value by itself counts as a list of one."""
        if not isinstance(self.value, list):
            yield self
            return
        if not self.value:
            raise self.error("is empty; leave it out or give at least one value")
        for index, value in enumerate(self.value):
            yield Entry(self.document, f"{self.path}[{index}]", value)

    def text(self) -> str:
        """A text that isn't empty."""
        if not isinstance(self.value, str) or not self.value:
            raise self.unfit("a text")
        return self.value

    def one_of(self, choices: Collection[str]) -> str:
        """One of some texts."""
        if not isinstance(self.value, str) or self.value not in choices:
            raise self.unfit("one of " + ", ".join(choices))
        return self.value

    def whole(self, least: int, most: int) -> int:
        """A whole number within limits, both included."""
        if type(self.value) is not int or not least <= self.value <= most:
            raise self.unfit(f"a whole number of {least}..{most}")
        return self.value

    def number(self, least: float, most: float = math.inf) -> float:
        """A finite number within limits, both included."""
        if type(self.value) not in (int, float) or not math.isfinite(self.value) or not least <= self.value <= most:
            limits = f" of at least {least:g}" if most == math.inf else f" of {least:g}..{most:g}"
            raise self.unfit("a finite number" + (limits if math.isfinite(least) else ""))
        return float(self.value)

    def settings(self, kind: type[Any], leave_out: Collection[str] = ()) -> dict[str, Any]:
        """Keyword arguments of a dataclass of settings; ranges are left to the dataclass."""
        hints = get_type_hints(kind)
        known = [setting.name for setting in fields(kind) if setting.name not in leave_out]
        return {key: entry.as_kind(hints[key]) for key, entry in self.mapping(known).items()}

    def as_kind(self, hint: Any) -> Any:
        """The value as a field of some type takes it."""
        if get_origin(hint) in (Union, types.UnionType):
            if self.value is None:
                return None
            hint = next(kind for kind in get_args(hint) if kind is not type(None))
        if hint is bool:
            if not isinstance(self.value, bool):
                raise self.unfit("true or false")
            return self.value
        if hint is int:
            if type(self.value) is not int:
                raise self.unfit("a whole number")
            return self.value
        if hint is float:
            return self.number(-math.inf)
        if get_origin(hint) is Literal:
            return self.one_of(get_args(hint))
        return self.text()


def read_document(text: str, where: str, *, numbered: bool = True) -> Entry:
    """A YAML text.

    Args:
        text: one document; a mapping whose keys differ from each other.
        where: its file, for people.
        numbered: whether errors tell lines.

    Raises:
        ConfigurationError: it is no such text, or PyYAML isn't installed.
    """
    yaml = yaml_module()
    lines: dict[str, int] = {}
    try:
        note_lines(yaml, yaml.compose(text, Loader=yaml.SafeLoader), "", lines, where, set())
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f":{mark.line + 1}"
        reason = getattr(error, "problem", None) or " ".join(str(error).split())
        raise ConfigurationError(f"{where}{line}: this is no YAML: {reason}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{where}: this is no usable YAML: {type(error).__name__}: {error}") from error
    if not isinstance(value, dict):
        raise ConfigurationError(f"{where}: holds {brief.repr(value)}; a sweep's configuration is a mapping of keys")
    return Entry(Document(where, lines if numbered else {}), "", value)


def note_lines(yaml: Any, node: Any, path: str, lines: dict[str, int], where: str, seen: set[int]) -> None:
    """Writes down where each key stands, and refuses keys that stand twice: YAML would let the last one win."""
    if node is None or id(node) in seen:
        return
    seen.add(id(node))
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            note_lines(yaml, item, f"{path}[{index}]", lines, where, seen)
    elif isinstance(node, yaml.MappingNode):
        first: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(key.value), key.start_mark.line + 1
            below = f"{path}.{name}" if path else name
            if name in first:
                raise ConfigurationError(f"{where}:{line}: {below} was given in line {first[name]} already; keep one")
            first[name] = lines[below] = line
            note_lines(yaml, value, below, lines, where, seen)


def yaml_module() -> Any:
    """``yaml``, which an edge box does not need.

    Raises:
        ConfigurationError: it isn't installed.
    """
    try:
        return import_module("yaml")
    except ModuleNotFoundError:
        raise ConfigurationError("a sweep's configuration needs PyYAML: pip install 'cable-rpc[study]'") from None
