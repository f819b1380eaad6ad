"""One camera of a nuScenes scene as a frame source."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cable_rpc.data.bad_frames import BadFrames
from cable_rpc.data.frame_rate import nominal_fps, thinned
from cable_rpc.data.image_file import read_whole_image
from cable_rpc.data.names import safe_name
from cable_rpc.data.nuscenes.can_bus import CanMotion
from cable_rpc.data.nuscenes.scene import CameraImage, Scene
from cable_rpc.data.nuscenes.truth import truth_of
from cable_rpc.data.poses import LEAST_POSES, motion_from_poses
from cable_rpc.data.resize import resize_frame
from cable_rpc.errors import SourceError
from cable_rpc.types import CameraMount, EgoMotion, Frame

FRONT_CAMERA = "CAM_FRONT"
LONE_FRAME_FPS = 12.0
"""Rate of the cameras, stated where a single image tells none."""
AHEAD_RAD = 0.35
"""Largest angle between the optical axis and the direction of travel of a forward-looking camera."""


@dataclass(frozen=True, slots=True)
class NuScenesView:
    """How a scene is delivered."""

    camera: str = FRONT_CAMERA
    interpolate: bool = False
    """Truth on the frames between keyframes too."""
    key_frames_only: bool = False
    """Leave the sweeps out: 2 frames per second, all annotated."""
    can: CanMotion | None = None
    """In place of the poses' differences."""
    size: tuple[int, int] | None = None
    """(width, height) to resize to."""
    fps: float | None = None
    """Thin to this rate by the time stamps, where the camera's is higher."""
    max_frames: int | None = None
    bad_frames: BadFrames = field(default_factory=BadFrames)


class NuScenesSource:
    """A camera's images of one scene, keyframes and sweeps, at their true times.

    Images are read one at a time. Ego-motion is that of the vehicle's origin, the middle of the rear axle.

    Args:
        root: the data set's folder.
        scene: its tables.
        view: what is asked of it.

    Raises:
        SourceError: keyframes only are asked for and there are none.
    """

    def __init__(self, root: Path, scene: Scene, view: NuScenesView) -> None:
        self.name = safe_name(scene.name if view.camera == FRONT_CAMERA else f"{scene.name}-{view.camera}")
        self._root, self._scene, self._view = root, scene, view
        self._egos = ego_motion(scene.images, view.can)
        places = [place for place, image in enumerate(scene.images) if image.is_key_frame or not view.key_frames_only]
        if not places:
            raise SourceError(f"scene '{scene.name}' has no keyframe of {view.camera}")
        times = [scene.images[place].time_ns for place in places]
        rate = nominal_fps(times)
        if view.fps is not None and rate is not None and view.fps < rate:
            places, rate = [places[kept] for kept in thinned(times, view.fps)], view.fps
        self.fps = rate or view.fps or LONE_FRAME_FPS
        self._chosen = places[: view.max_frames]
        self.size_wh = scene.images[0].size_wh if view.size is None else view.size
        self.frame_count: int | None = len(self._chosen)
        """Of frames in the tables; a skipped one is delivered less."""

    def __iter__(self) -> Iterator[Frame]:
        """Frames with index 0, 1, 2, ...; times are the set's own, since 1970.

        Raises:
            SourceError: an image is missing, damaged or of another size, unless that is to be skipped.
        """
        index = 0
        for place in self._chosen:
            try:
                frame = self._frame(place, index)
            except SourceError as error:
                self._view.bad_frames.found(error)
                continue
            yield frame
            index += 1

    def _frame(self, place: int, index: int) -> Frame:
        image = self._scene.images[place]
        path = self._root / image.file_name
        pixels = read_whole_image(path)
        found = (pixels.shape[1], pixels.shape[0])
        if found != image.size_wh:
            stated = f"{image.size_wh[0]}x{image.size_wh[1]}"
            raise SourceError(f"{path} is {found[0]}x{found[1]}, but its row in sample_data.json says {stated}")
        frame = Frame(
            pixels,
            index,
            image.time_ns,
            self._egos[place],
            image.calibration.intrinsics,
            truth_of(self._scene, image, self._view.interpolate),
            mount_of(image.calibration.vehicle_from_camera),
        )
        return resize_frame(frame, self.size_wh)


def ego_motion(images: Sequence[CameraImage], can: CanMotion | None) -> list[EgoMotion | None]:
    """Ego-motion at each image: from the CAN bus, else by differences of the poses; None where not known."""
    if can is not None:
        return [can.at(image.time_ns) for image in images]
    if len(images) < LEAST_POSES:
        return [None] * len(images)
    times = np.array([image.time_ns for image in images], np.int64)
    return list(motion_from_poses(times, np.array([image.world_from_vehicle for image in images])))


def mount_of(vehicle_from_camera: npt.NDArray[np.float64]) -> CameraMount | None:
    """Where a camera sits; None where it doesn't look ahead.

    Args:
        vehicle_from_camera: float64 [4, 4], vehicle x forward, y left, z up, origin on the road.
    """
    forward, left, up = vehicle_from_camera[:3, 2].tolist()
    if abs(math.atan2(left, forward)) > AHEAD_RAD:
        return None
    ahead, _, height = vehicle_from_camera[:3, 3].tolist()
    return CameraMount(height, math.asin(max(-1.0, min(1.0, -up))), ahead)
