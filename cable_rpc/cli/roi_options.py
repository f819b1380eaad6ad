"""Settings of the region of interest and of its treatment as texts on the command line."""

from __future__ import annotations

import types
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, Union, get_args, get_origin, get_type_hints

from cable_codecs import STILL_CODECS, CodecError, RegionTreatment

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError

MODES = ("robust", "paper")
TRUTHS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def roi_config(mode: str, changes: Iterable[str] = (), keyframes: str | None = None) -> RoiConfig:
    """The settings of a mode with single switches changed.

    Args:
        mode: ``robust`` or ``paper``.
        changes: ``KEY=VALUE`` each; a key is a field of `RoiConfig`.
        keyframes: name of the keyframe policy; None leaves the mode's.

    Raises:
        ConfigurationError: unknown mode, key or value.
    """
    if mode not in MODES:
        raise ConfigurationError(f"--mode is '{mode}'; use {' or '.join(MODES)}")
    config = RoiConfig.paper() if mode == "paper" else RoiConfig()
    settings = parse_roi_changes(changes)
    if keyframes is not None:
        settings["keyframe_policy"] = keyframes
    return replace(config, **settings)


def region_treatment(codec: str, changes: Iterable[str] = ()) -> RegionTreatment:
    """What measured best for a codec, with single switches changed.

    Args:
        codec: name of the codec.
        changes: ``KEY=VALUE`` each; a key is a field of `RegionTreatment`.

    Raises:
        ConfigurationError: unknown key or value, or a treatment that the codec can't carry.
    """
    stateless = codec in STILL_CODECS
    settings = parse_changes(RegionTreatment, changes, "--treatment")
    try:
        treatment = replace(RegionTreatment.default_for(stateless=stateless), **settings)
        treatment.check_codec(codec, stateless=stateless)
    except CodecError as error:
        raise ConfigurationError(f"--treatment: {error}") from error
    return treatment


def parse_roi_changes(changes: Iterable[str]) -> dict[str, Any]:
    """``["ego_model=flow", "top_margin=0.2"]`` as keyword arguments of `RoiConfig`.

    Raises:
        ConfigurationError: a text isn't KEY=VALUE, or the key or the kind of value is unknown.
    """
    return parse_changes(RoiConfig, changes, "--roi")


def parse_changes(
    settings_type: type[RoiConfig] | type[RegionTreatment], changes: Iterable[str], option: str
) -> dict[str, Any]:
    """``KEY=VALUE`` texts as keyword arguments of a dataclass of settings.

    Raises:
        ConfigurationError: a text isn't KEY=VALUE, or the key or the kind of value is unknown.
    """
    hints = get_type_hints(settings_type)
    known = [setting.name for setting in fields(settings_type)]
    settings: dict[str, Any] = {}
    for change in changes:
        key, separator, text = change.partition("=")
        key = key.strip().replace("-", "_")
        if not separator or key not in known:
            raise ConfigurationError(f"{option} '{change}': write KEY=VALUE with one of the keys {', '.join(known)}")
        settings[key] = parse_value(f"{option} {key}", hints[key], text.strip())
    return settings


def parse_value(key: str, hint: Any, text: str) -> bool | int | float | str | None:
    """A setting's value from its text, by the type of its field."""
    if get_origin(hint) in (Union, types.UnionType):
        if text.lower() in ("none", "never"):
            return None
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if hint is bool:
        if text.lower() not in TRUTHS:
            raise ConfigurationError(f"{key}={text}: write true or false")
        return TRUTHS[text.lower()]
    if hint in (int, float):
        try:
            number: int | float = hint(text)
        except ValueError:
            kind = "a whole number" if hint is int else "a number"
            raise ConfigurationError(f"{key}={text}: write {kind}") from None
        return number
    return text
