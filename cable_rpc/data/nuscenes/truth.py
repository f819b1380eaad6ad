"""A scene's annotations as the truth of one image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cable_rpc.data.cuboids import cuboid_corners, project_corners
from cable_rpc.data.nuscenes.annotations import Annotation, annotations_between
from cable_rpc.data.nuscenes.scene import CameraImage, Scene
from cable_rpc.data.poses import inverse_rigid
from cable_rpc.types import GroundTruth


def truth_of(scene: Scene, image: CameraImage, interpolate: bool) -> GroundTruth | None:
    """What is to be seen in an image of a scene.

    A keyframe has its sample's annotations as they are, although it was taken up to 50 ms beside them, as in the
    devkit; annotators checked them against these images.

    Returns:
        None where nothing is known: in a test set, and between keyframes unless these are to be interpolated.
    """
    if scene.annotations is None:
        return None
    if image.is_key_frame:
        return projected(scene.annotations[image.sample_token], image)
    if not interpolate:
        return None
    found = annotations_between(scene.annotations, scene.sample_times_ns, image.time_ns)
    return None if found is None else projected(found, image)


def projected(annotations: Sequence[Annotation], image: CameraImage) -> GroundTruth:
    """Boxes around annotations in the map's axes as seen by an image's camera from where it was then."""
    camera_from_world = inverse_rigid(image.world_from_vehicle @ image.calibration.vehicle_from_camera)
    corners = cuboid_corners([one.cuboid for one in annotations])
    found = project_corners(corners, camera_from_world, image.calibration.intrinsics, image.size_wh)
    boxes = found.boxes_xyxy
    inside = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    ignored = np.array([one.ignored for one in annotations], np.bool_)
    shares = np.array([one.visibility for one in annotations], np.float32)
    rows = np.flatnonzero(inside & ~ignored).tolist()
    unknown = boxes[inside & ignored]
    return GroundTruth(
        boxes[rows],
        np.array([annotations[row].cuboid.class_id for row in rows], np.int32),
        np.array([annotations[row].cuboid.track_id for row in rows], np.int32),
        np.minimum(shares, found.inside_share)[rows],
        ignored_boxes_xyxy=unknown if len(unknown) else None,
    )
