"""What a codec study does to the background before coding: one table, a line for each treatment."""

from __future__ import annotations

from collections.abc import Mapping

from cable_codecs import CodecError, CodecParameters, create_encoder
from cable_codecs.registry import STILL_CODECS
from cable_codecs.treatment import RegionTreatment

from cable_rpc.errors import ConfigurationError

WHOLE = "whole"
"""Every frame as it is, what all treatments are measured against."""

TREATMENTS: Mapping[str, RegionTreatment] = {
    "pixel-zero": RegionTreatment(grid=1),
    "pixel-grey": RegionTreatment(grid=1, fill="grey"),
    "pixel-mean": RegionTreatment(grid=1, fill="mean"),
    "pixel-blur": RegionTreatment(grid=1, fill="blur"),
    "feather8-grey": RegionTreatment(grid=1, fill="grey", feather_px=8),
    "align8-zero": RegionTreatment(),
    "align8-grey": RegionTreatment(fill="grey"),
    "align8-mean": RegionTreatment(fill="mean"),
    "align8-blur": RegionTreatment(fill="blur"),
    "align8-freeze": RegionTreatment(fill="freeze"),
    "align8-hold": RegionTreatment(hold_frames=5),
    "align8-compose": RegionTreatment(compose=True),
    "align8-rows": RegionTreatment(crop="rows"),
    "align8-box": RegionTreatment(crop="box"),
    "align8-half": RegionTreatment(scale=0.5),
    "align16-zero": RegionTreatment(grid=16),
    "align16-grey": RegionTreatment(grid=16, fill="grey"),
    "align16-hold": RegionTreatment(grid=16, hold_frames=5),
    "align16-freeze": RegionTreatment(grid=16, fill="freeze"),
    "soft-0.1": RegionTreatment(grid=16, fill="keep", quantiser_offset=0.1),
    "soft-0.2": RegionTreatment(grid=16, fill="keep", quantiser_offset=0.2),
    "soft-0.4": RegionTreatment(grid=16, fill="keep", quantiser_offset=0.4),
}
"""Name to treatment: the grid that the region is grown to, then what is done with the rest."""


def find_treatment(name: str) -> RegionTreatment | None:
    """The treatment of a name, None for whole frames.

    Raises:
        ConfigurationError: Unknown.
    """
    if name == WHOLE:
        return None
    if name not in TREATMENTS:
        raise ConfigurationError(f"treatment '{name}' is unknown; use some of {WHOLE}, {', '.join(TREATMENTS)}")
    return TREATMENTS[name]


def applies(treatment: RegionTreatment, codec: str) -> bool:
    """Whether a codec can carry a treatment; video codecs can't crop, image codecs can't freeze, AV1 has no offsets."""
    try:
        treatment.check_codec(codec, stateless=codec in STILL_CODECS)
        if treatment.quantiser_offset > 0:
            create_encoder(CodecParameters(codec, 64, 64, background_offset=treatment.quantiser_offset)).close()
    except CodecError:
        return False
    return True
