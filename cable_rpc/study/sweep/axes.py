"""The axes of a sweep's configuration: each key's values, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path

from cable_codecs import STILL_CODECS, CodecError, RegionTreatment
from cable_codecs.registry import CODECS, VIDEO_FORMATS, unavailability

from cable_rpc.edge.roi_config import RoiConfig
from cable_rpc.errors import ConfigurationError
from cable_rpc.study.codec_study import QUALITIES as USUAL_QUALITIES
from cable_rpc.study.strategies import STRATEGIES
from cable_rpc.study.study_treatments import applies
from cable_rpc.study.sweep.cell import RatePoint
from cable_rpc.study.sweep.config_entry import Entry
from cable_rpc.study.sweep.link_trace import read_trace
from cable_rpc.study.sweep.simulated_link import SimulatedLink

ROI_MODES = ("robust", "paper")
LONGEST_LABEL = 40
LARGEST_DELAY = 1000
TRACE_KEYS = ("trace", "column", "start_s", "seconds")
LINK_KEYS = (*TRACE_KEYS, *(one.name for one in fields(SimulatedLink) if one.name not in ("name", "trace_ms")))
RATE_KEYS = ("quality", "bitrate_kbps")
HIGHEST_KBPS = 1_000_000


@dataclass(frozen=True, slots=True)
class NamedRoi:
    """ROI settings and what they are called."""

    label: str
    config: RoiConfig


def labelled(entry: Entry) -> dict[str, Entry]:
    """Values by labels, which become part of the names of methods."""
    found = entry.mapping()
    for label, value in found.items():
        if not label.isprintable() or not 0 < len(label) <= LONGEST_LABEL or "·" in label:
            raise value.error(f"has a label that can't be used; take 1..{LONGEST_LABEL} printable characters, no '·'")
    return found


def read_strategy(entry: Entry) -> str:
    """A strategy's name."""
    name = entry.text()
    kind, _, argument = name.partition(":")
    if kind not in {known.partition(":")[0] for known in STRATEGIES} or (kind == "edge-boxes") != bool(argument):
        raise entry.unfit("one of " + ", ".join(STRATEGIES))
    return name


def read_rates(entry: Entry) -> dict[str, tuple[RatePoint, ...]]:
    """Codec to the points of its curves, from a mapping, or from a list of codecs at their usual qualities."""
    if not isinstance(entry.value, dict):
        return {read_codec(item, item.one_of(list(CODECS))): usual_rates(item.value) for item in entry.items()}
    return {codec: codec_rates(read_codec(below, codec), below) for codec, below in entry.mapping(list(CODECS)).items()}


def read_codec(entry: Entry, codec: str) -> str:
    """A codec that opens here."""
    reason = unavailability(codec)
    if reason is not None:
        raise entry.error(f"can't be opened here ({reason}); `cable-rpc doctor` says which codecs can")
    return codec


def usual_rates(codec: str) -> tuple[RatePoint, ...]:
    """Where nothing is said: what brings road scenes to 34 to 45 dB; one point for a lossless codec."""
    return tuple(RatePoint(quality) for quality in USUAL_QUALITIES.get(codec, (None,)))


def codec_rates(codec: str, entry: Entry) -> tuple[RatePoint, ...]:
    """The points of one codec's curve."""
    keys = entry.mapping(RATE_KEYS)
    points: list[RatePoint] = []
    if "quality" in keys:
        points += [RatePoint(quality) for quality in read_qualities(codec, keys["quality"])]
    if "bitrate_kbps" in keys:
        if codec == "webp-lossless":
            raise keys["bitrate_kbps"].error("has no meaning for webp-lossless; leave it out")
        rates = [item.whole(1, HIGHEST_KBPS) for item in keys["bitrate_kbps"].items()]
        points += [RatePoint(bitrate_kbps=rate) for rate in rates]
    return tuple(dict.fromkeys(points)) or usual_rates(codec)


def read_qualities(codec: str, entry: Entry) -> list[int]:
    """Qualities within a codec's range."""
    if codec == "webp-lossless":
        raise entry.error("has no meaning for webp-lossless; leave it out")
    low, high = sorted(VIDEO_FORMATS[codec].quality_range) if codec in VIDEO_FORMATS else (1, 100)
    return [item.whole(low, high) for item in entry.items()]


def read_treatments(
    entry: Entry, codecs: tuple[str, ...]
) -> tuple[dict[str, dict[str, RegionTreatment]], tuple[str, ...]]:
    """What becomes of regions before coding: label to codec to treatment, and what was left out and why.

    A treatment is made of changes of what measured best for the codec.
    """
    below = labelled(entry) or {"default": Entry(entry.document, f"{entry.path}.default", None)}
    found: dict[str, dict[str, RegionTreatment]] = {}
    notes: list[str] = []
    reasons: dict[str, str] = {}
    for label, one in below.items():
        if isinstance(one.value, dict) and "scale" in one.value:
            raise one.mapping()["scale"].error("is an axis of its own; give it as upload_scale of the grid")
        switches = one.settings(RegionTreatment, ("scale",))
        found[label] = {}
        for codec in codecs:
            try:
                treatment = treatment_for(codec, switches)
                same = next((other for other in found if found[other].get(codec) == treatment), None)
                if same is not None:
                    notes.append(f"{one.path} is for {codec} the same as '{same}', and is one with it")
                found[label][codec] = treatment
            except CodecError as error:
                reasons[codec] = str(error)
                notes.append(f"{one.path} is left out for {codec}: {error}")
        if not found[label]:
            raise one.error(f"can't be used: {reasons[codecs[-1]]}")
    for codec in codecs:
        if not any(codec in by_codec for by_codec in found.values()):
            raise entry.error(f"has nothing that {codec} can carry: {reasons[codec]}")
    return found, tuple(notes)


def treatment_for(codec: str, switches: dict[str, object]) -> RegionTreatment:
    """Changes of a codec's best treatment.

    Raises:
        CodecError: a value is outside its range, or the codec can't carry pictures treated so.
    """
    stateless = codec in STILL_CODECS
    treatment = replace(RegionTreatment.default_for(stateless=stateless), **switches)  # type: ignore[arg-type]
    treatment.check_codec(codec, stateless=stateless)
    if not applies(treatment, codec):
        raise CodecError(f"{codec} has no quantiser offsets; use quantiser_offset=0 or another codec")
    return treatment


def read_fps(entry: Entry) -> float | None:
    """Frames per second; None for the source's own."""
    return None if entry.value is None else entry.number(0.1, 1000)


def read_link(label: str, entry: Entry) -> SimulatedLink | None:
    """A link; None for none."""
    if entry.value is None:
        return None
    keys = entry.mapping(LINK_KEYS)
    trace: tuple[int, ...] = ()
    part = {name: keys[name] for name in TRACE_KEYS if name in keys}
    if part and "trace" not in part:
        raise entry.error(f"has {', '.join(part)} without a trace; name its file as 'trace'")
    try:
        if part:
            trace = tuple(
                read_trace(
                    Path(part["trace"].text()).expanduser(),
                    part["column"].text() if "column" in part else None,
                    part["start_s"].number(0) if "start_s" in part else 0.0,
                    part["seconds"].number(0.001) if "seconds" in part else math.inf,
                )
            )
        plain = Entry(entry.document, entry.path, {key: one.value for key, one in keys.items() if key not in part})
        settings = plain.settings(SimulatedLink, ("name", "trace_ms"))
        return SimulatedLink(label, trace_ms=trace, **settings)
    except ConfigurationError as error:
        if str(error).startswith(entry.document.where):
            raise
        raise entry.error(f"can't be used: {error}") from error


def read_roi(entry: Entry) -> RoiConfig:
    """ROI settings: a mode with single switches changed."""
    keys = entry.mapping([*(one.name for one in fields(RoiConfig)), "mode"])
    mode = keys.pop("mode").one_of(ROI_MODES) if "mode" in keys else "robust"
    plain = Entry(entry.document, entry.path, {key: one.value for key, one in keys.items()})
    settings = plain.settings(RoiConfig)
    try:
        return RoiConfig.paper(**settings) if mode == "paper" else RoiConfig(**settings)
    except ConfigurationError as error:
        raise entry.error(f"can't be used: {error}") from error
