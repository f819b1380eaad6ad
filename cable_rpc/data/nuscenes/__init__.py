"""nuScenes, and what is published in its format (Lyft Level 5)."""

from cable_rpc.data.nuscenes.opening import open_nuscenes, sequences
from cable_rpc.data.nuscenes.source import NuScenesSource
from cable_rpc.data.nuscenes.writer import write_nuscenes

__all__ = ["NuScenesSource", "open_nuscenes", "sequences", "write_nuscenes"]
