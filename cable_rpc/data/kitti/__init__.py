"""KITTI tracking: sequences of the left colour camera with boxes, GPS/IMU motion and calibration."""

from cable_rpc.data.kitti.opening import open_kitti, sequences
from cable_rpc.data.kitti.source import KittiSource
from cable_rpc.data.kitti.writer import write_kitti

__all__ = ["KittiSource", "open_kitti", "sequences", "write_kitti"]
