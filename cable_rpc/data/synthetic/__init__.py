"""A rendered driving world with exact truth: streets, traffic, people, weather and a camera, all from a seed."""

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.source import SyntheticConfig, SyntheticSource

__all__ = ["Camera", "SyntheticConfig", "SyntheticSource"]
