"""A sweep's configuration from options of the command: the YAML text that says the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from cable_codecs import STILL_CODECS

from cable_rpc.errors import ConfigurationError
from cable_rpc.study.sweep.config_entry import read_document, yaml_module

DEFAULT_CODEC = "h264"
NO_LINK = "none"


@dataclass(frozen=True, slots=True)
class AxisFlags:
    """Options that stand for axes, as texts; empty where they weren't given."""

    data: Sequence[str] = ()
    strategy: Sequence[str] = ()
    treatment: Sequence[str] = ()
    """``LABEL`` or ``LABEL:KEY=VALUE,KEY=VALUE``."""
    codec: Sequence[str] = ()
    quality: Sequence[str] = ()
    """``A,B,C`` for the only codec, ``CODEC=A,B,C`` for one of several."""
    bitrate: Sequence[str] = ()
    """As ``quality``, or ``A,B,C`` for all video codecs."""
    fps: Sequence[str] = ()
    upload_scale: Sequence[str] = ()
    feedback_delay: Sequence[str] = ()
    link: Sequence[str] = ()
    """As ``treatment``; ``none`` for no link."""
    roi: Sequence[str] = ()
    """``KEY=VALUE``."""

    def given(self) -> list[str]:
        """Names of those that were given."""
        return [one.name for one in fields(self) if getattr(self, one.name)]


@dataclass(frozen=True, slots=True)
class SweepFlags:
    """All options that say what to measure."""

    axes: AxisFlags = field(default_factory=AxisFlags)
    scalars: Mapping[str, Any] = field(default_factory=dict)
    """Key of one value in the configuration to value; those that weren't given are left out."""


def text_of_flags(flags: SweepFlags) -> str:
    """The configuration that options alone make.

    Raises:
        ConfigurationError: there is no ``--data``, or an option is written in no such way.
    """
    axes = flags.axes
    if not axes.data:
        raise ConfigurationError(
            "a sweep needs a configuration, or --data: cable-rpc sweep CONFIG.yaml, or cable-rpc sweep "
            "--data video:drive.mp4"
        )
    document: dict[str, Any] = {"sequences": list(axes.data), **flags.scalars}
    if axes.roi:
        document["roi"] = dict(key_value("--roi", text) for text in axes.roi)
    grid: dict[str, Any] = {"codecs": codecs_of(axes)}
    if axes.strategy:
        grid["strategies"] = [name for text in axes.strategy for name in text.split(",")]
    if axes.treatment:
        grid["treatments"] = dict(labelled_switches("--treatment", text) for text in axes.treatment)
    for name in ("fps", "upload_scale", "feedback_delay"):
        if getattr(axes, name):
            grid[name] = values_of(",".join(getattr(axes, name)))
    if axes.link:
        links = dict(labelled_switches("--link", text) for text in axes.link)
        grid["links"] = {label: None if label == NO_LINK else switches for label, switches in links.items()}
    return as_yaml({**document, "grids": [grid]})


def text_with_flags(text: str, where: str, flags: SweepFlags) -> str:
    """A configuration in which options replace keys of one value.

    Raises:
        ConfigurationError: the text is no YAML, or an option stands for an axis, which the text must say.
    """
    given = flags.axes.given()
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ConfigurationError(f"{options}: {where} holds the axes; change them there, or leave the file out")
    if not flags.scalars:
        return text
    return as_yaml({**read_document(text, where).value, **flags.scalars})


def codecs_of(axes: AxisFlags) -> dict[str, Any]:
    """Codec to its qualities and bit rates."""
    found: dict[str, dict[str, Any]] = {codec: {} for codec in axes.codec or (DEFAULT_CODEC,)}
    for option, key, texts in (("--quality", "quality", axes.quality), ("--bitrate", "bitrate_kbps", axes.bitrate)):
        for text in texts:
            codec, separator, numbers = text.rpartition("=")
            if separator and codec not in found:
                raise ConfigurationError(f"{option} '{text}': there is no --codec {codec}; add it")
            wanted = (
                [codec] if separator else [name for name in found if not (key != "quality" and name in STILL_CODECS)]
            )
            if not separator and key == "quality" and len(found) > 1:
                raise ConfigurationError(
                    f"{option} '{text}': qualities of different codecs don't compare; write CODEC=A,B,C for each of "
                    + ", ".join(found)
                )
            if not wanted:
                raise ConfigurationError(f"{option} '{text}': needs a video codec; add --codec h264")
            for name in wanted:
                found[name].setdefault(key, []).extend(values_of(numbers))
    return {codec: rates or None for codec, rates in found.items()}


def labelled_switches(option: str, text: str) -> tuple[str, dict[str, Any]]:
    """``soft:fill=keep,quantiser_offset=0.4`` as a label and its switches."""
    label, _, rest = text.partition(":")
    if not label:
        raise ConfigurationError(f"{option} '{text}': write LABEL or LABEL:KEY=VALUE,KEY=VALUE")
    return label, dict(key_value(option, part) for part in rest.split(",") if part)


def key_value(option: str, text: str) -> tuple[str, Any]:
    """``fill=keep`` as key and value."""
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigurationError(f"{option} '{text}': write KEY=VALUE")
    return key.strip().replace("-", "_"), value_of(value)


def values_of(text: str) -> list[Any]:
    """ "20,24" as numbers; what isn't one is left for the configuration to refuse."""
    return [value_of(part) for part in text.split(",") if part.strip()]


def value_of(text: str) -> Any:
    """A scalar as YAML reads it."""
    yaml = yaml_module()
    try:
        value = yaml.safe_load(text.strip())
    except yaml.YAMLError:
        return text
    return text.strip() if isinstance(value, (list, dict)) else value


def as_yaml(document: Mapping[str, Any]) -> str:
    """A document as text, keys in their order."""
    return str(yaml_module().safe_dump(dict(document), sort_keys=False, allow_unicode=True, width=120))
