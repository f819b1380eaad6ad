"""The Waymo Open Dataset, version 2 (Parquet components) and version 1 (TFRecord)."""

from cable_rpc.data.waymo.opening import open_waymo, sequences
from cable_rpc.data.waymo.source import WaymoSource
from cable_rpc.data.waymo.writer import write_waymo
from cable_rpc.data.waymo.writer_v1 import write_waymo_v1

__all__ = ["WaymoSource", "open_waymo", "sequences", "write_waymo", "write_waymo_v1"]
