"""Image sequences annotated in COCO's JSON format, panoramas among them."""

from cable_rpc.data.coco.opening import open_coco_video, open_wod_zb, sequences
from cable_rpc.data.coco.source import CocoSource
from cable_rpc.data.coco.writer import write_coco

__all__ = ["CocoSource", "open_coco_video", "open_wod_zb", "sequences", "write_coco"]
