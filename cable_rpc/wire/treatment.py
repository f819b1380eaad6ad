"""The treatment of regions between its message and `cable_codecs.RegionTreatment`."""

from __future__ import annotations

from typing import Any

from cable_codecs import CodecError, RegionTreatment

from cable_rpc.errors import ProtocolError
from cable_rpc.wire.v1 import perception_pb2 as pb

FILLS: dict[str, pb.BackgroundFill] = {
    "zero": pb.BACKGROUND_FILL_ZERO,
    "grey": pb.BACKGROUND_FILL_GREY,
    "mean": pb.BACKGROUND_FILL_MEAN,
    "blur": pb.BACKGROUND_FILL_BLUR,
    "freeze": pb.BACKGROUND_FILL_FREEZE,
    "keep": pb.BACKGROUND_FILL_KEEP,
}
CROPS: dict[str, pb.CropMode] = {
    "none": pb.CROP_MODE_UNSPECIFIED,
    "rows": pb.CROP_MODE_ROWS,
    "box": pb.CROP_MODE_BOX,
}
REFILLS: dict[str, pb.BackgroundRefill] = {
    "constant": pb.BACKGROUND_REFILL_UNSPECIFIED,
    "diffuse": pb.BACKGROUND_REFILL_DIFFUSE,
}
INTERPOLATIONS: dict[str, pb.Interpolation] = {
    "cubic": pb.INTERPOLATION_CUBIC,
    "linear": pb.INTERPOLATION_LINEAR,
    "nearest": pb.INTERPOLATION_NEAREST,
    "lanczos": pb.INTERPOLATION_LANCZOS,
}


def treatment_to_message(treatment: RegionTreatment) -> pb.RegionTreatment:
    """What the server must know of a treatment."""
    return pb.RegionTreatment(
        fill=FILLS[treatment.fill],
        grid=treatment.grid,
        crop=CROPS[treatment.crop],
        scale=treatment.scale,
        interpolation=INTERPOLATIONS[treatment.interpolation],
        feather_px=treatment.feather_px,
        compose=treatment.compose,
        refill=REFILLS[treatment.refill],
    )


def treatment_from_message(message: pb.RegionTreatment) -> RegionTreatment:
    """The receiver's side of a treatment; what only concerns the sender has its default.

    Raises:
        ProtocolError: an unknown value, or switches that contradict each other.
    """
    fields: dict[str, Any] = {
        "fill": name_of(message.fill or pb.BACKGROUND_FILL_ZERO, FILLS, "fill"),
        "grid": message.grid or 1,
        "crop": name_of(message.crop, CROPS, "crop"),
        "scale": message.scale or 1.0,
        "interpolation": name_of(message.interpolation or pb.INTERPOLATION_CUBIC, INTERPOLATIONS, "interpolation"),
        "feather_px": message.feather_px,
        "compose": message.compose,
        "refill": name_of(message.refill, REFILLS, "refill"),
    }
    try:
        return RegionTreatment(**fields)
    except CodecError as error:
        raise ProtocolError(f"RegionTreatment is unusable: {error}") from error


def name_of(number: int, names: dict[str, Any], field: str) -> str:
    """The name that a number stands for.

    Raises:
        ProtocolError: none.
    """
    for name, known in names.items():
        if known == number:
            return name
    raise ProtocolError(f"RegionTreatment.{field} is {number}, which this server does not know")
