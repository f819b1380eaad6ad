"""Canadian Adverse Driving Conditions: winter drives, front camera, boxes projected from lidar cuboids."""

from cable_rpc.data.cadc.opening import open_cadc, sequences
from cable_rpc.data.cadc.source import CadcSource
from cable_rpc.data.cadc.writer import write_cadc

__all__ = ["CadcSource", "open_cadc", "sequences", "write_cadc"]
