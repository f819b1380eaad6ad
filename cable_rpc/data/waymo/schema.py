"""The few fields of Waymo's protocol buffers that are used here, declared at run time.

Field numbers: waymo_open_dataset/dataset.proto and label.proto. Enumerations are read as int32, which is the same on
the wire; every other field of a record stays unknown and is skipped.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

PACKAGE = "waymo_subset"
REPEATED = "[]"

MESSAGES: Mapping[str, tuple[tuple[str, int, str], ...]] = {
    "Transform": (("transform", 1, "double[]"),),
    "Velocity": (
        ("v_x", 1, "float"),
        ("v_y", 2, "float"),
        ("v_z", 3, "float"),
        ("w_x", 4, "double"),
        ("w_y", 5, "double"),
        ("w_z", 6, "double"),
    ),
    "CameraCalibration": (
        ("name", 1, "int32"),
        ("intrinsic", 2, "double[]"),
        ("extrinsic", 3, "Transform"),
        ("width", 4, "int32"),
        ("height", 5, "int32"),
    ),
    "Context": (("name", 1, "string"), ("camera_calibrations", 2, "CameraCalibration[]")),
    "CameraImage": (
        ("name", 1, "int32"),
        ("image", 2, "bytes"),
        ("pose", 3, "Transform"),
        ("velocity", 4, "Velocity"),
        ("pose_timestamp", 5, "double"),
    ),
    "Box": (("center_x", 1, "double"), ("center_y", 2, "double"), ("width", 4, "double"), ("length", 5, "double")),
    "Label": (("box", 1, "Box"), ("type", 3, "int32"), ("id", 4, "string"), ("detection_difficulty_level", 5, "int32")),
    "CameraLabels": (("name", 1, "int32"), ("labels", 2, "Label[]")),
    "Frame": (
        ("context", 1, "Context"),
        ("timestamp_micros", 2, "int64"),
        ("pose", 3, "Transform"),
        ("images", 4, "CameraImage[]"),
        ("camera_labels", 8, "CameraLabels[]"),
    ),
}
"""Message to its fields: name, number and type, ``[]`` behind it where repeated."""


@lru_cache(maxsize=1)
def frame_class() -> Any:
    """The class of ``Frame`` messages; the others are reached through its fields."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}.proto", package=PACKAGE, syntax="proto2")
    for message_name, fields in MESSAGES.items():
        message = file.message_type.add(name=message_name)
        for name, number, kind in fields:
            add_field(message, name, number, kind)
    # A pool of its own: the official package may be loaded in the same process.
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.Frame"))


def add_field(message: descriptor_pb2.DescriptorProto, name: str, number: int, kind: str) -> None:
    """Declare one field of a message."""
    field_types = descriptor_pb2.FieldDescriptorProto
    plain = kind.removesuffix(REPEATED)
    field = message.field.add(
        name=name,
        number=number,
        label=field_types.LABEL_REPEATED if kind.endswith(REPEATED) else field_types.LABEL_OPTIONAL,
    )
    if plain in MESSAGES:
        field.type = field_types.TYPE_MESSAGE
        field.type_name = f".{PACKAGE}.{plain}"
    else:
        field.type = field_types.Type.Value(f"TYPE_{plain.upper()}")
