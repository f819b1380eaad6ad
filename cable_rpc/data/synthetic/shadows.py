"""Soft shadows on the ground."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import NEAR_PLANE_M
from cable_rpc.data.synthetic.raster import SUBPIXEL, SUBPIXEL_BITS, Target, clip_near
from cable_rpc.data.synthetic.road import Pose

UInt8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

SHRINK = 2
SHADOWS_M = 60.0
CORNERS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]] * 2)
CONTACT_CORNERS = CORNERS * np.repeat([0.11, 0.025], 4)[:, None]
"""How far the outlines of the contact shadow stand out, metres."""


class ShadowLayer:
    """A coarse darkness image, blurred and multiplied onto the ground."""

    def __init__(self, target: Target) -> None:
        self.target = target
        camera = target.camera
        self.top = max(0, min(camera.height - 1, int(camera.horizon_row)))
        height, width = -(-(camera.height - self.top) // SHRINK), -(-camera.width // SHRINK)
        self.contact: UInt8Array = np.zeros((height, width), np.uint8)
        self.cast: UInt8Array = np.zeros((height, width), np.uint8)
        ego = target.ego
        cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
        to_vehicle = np.array(
            [
                [cosine, sine, -cosine * ego.x - sine * ego.y],
                [sine, -cosine, -sine * ego.x + cosine * ego.y],
                [0, 0, 1],
            ]
        )
        to_mask = np.array(
            [[SUBPIXEL / SHRINK, 0, 0], [0, SUBPIXEL / SHRINK, -self.top * SUBPIXEL / SHRINK], [0, 0, 1]]
        )
        homography = to_mask @ camera.ground_to_image @ to_vehicle
        self.linear, self.offset = homography[:, :2].T.copy(), homography[:, 2]
        self.from_mask = np.linalg.pinv(self.linear)
        light = target.light
        rise = max(float(light.sun_direction[2]), 0.18)
        self.slope = -light.sun_direction[:2] / rise if light.shadow > 0.15 else None
        """Ground offset of a shadow per metre of height, None without cast shadows."""

    def fill(self, mask: UInt8Array, outline: FloatArray, strength: int) -> None:
        """Darken a convex ground polygon [N, 2] given in world metres."""
        self.lay(mask, outline @ self.linear + self.offset, strength)

    def lay(self, mask: UInt8Array, points: FloatArray, strength: int) -> None:
        """Darken a convex outline given in homogeneous mask points [N, 3]."""
        # The third homogeneous coordinate is the depth in metres.
        if points[:, 2].min() < NEAR_PLANE_M:
            points = clip_near(points)
            if len(points) < 3:
                return
        fixed = np.clip(points[:, :2] / points[:, 2:], -60000, 120000).astype(np.int32)
        cv2.fillConvexPoly(mask, fixed, strength, cv2.LINE_8, SUBPIXEL_BITS)

    def add_box(self, pose: Pose, length: float, width: float, height: float) -> None:
        """The contact shadow under an object and the shadow its box throws from the sun."""
        if self.outside(pose, max(length, height * 2)):
            return
        cosine, sine = math.cos(pose.heading), math.sin(pose.heading)
        axes = np.array([[cosine, sine], [sine, -cosine]]) @ self.linear
        centre = pose.x * self.linear[0] + pose.y * self.linear[1] + self.offset
        sizes = np.array([length, width]) / 2.0
        # The sun's offsets of the lower and upper outline join the two rectangles on the ground.
        points = (CONTACT_CORNERS + CORNERS * sizes) @ axes + centre
        self.lay(self.contact, points[:4], 90)
        self.lay(self.contact, points[4:], 190)
        if self.slope is None:
            return
        base = (CORNERS[:4] * (sizes * 0.94)) @ axes + centre
        thrown = self.slope @ self.linear
        self.lay_hull(np.vstack([base + thrown * 0.1, base + thrown * (height * 0.94)]))

    def throw(self, base: FloatArray, low: float, high: float) -> None:
        """The cast shadow of a prism over the world polygon [N, 2] between two heights."""
        if self.slope is None:
            return
        projected, thrown = base @ self.linear + self.offset, self.slope @ self.linear
        self.lay_hull(np.vstack([projected + thrown * low, projected + thrown * high]))

    def lay_hull(self, points: FloatArray) -> None:
        """Cast shadow over the convex hull of homogeneous mask points [N, 3]."""
        if points[:, 2].min() >= NEAR_PLANE_M:
            # Projection keeps convexity, so the hull may be taken in the image.
            flat = np.clip(points[:, :2] / points[:, 2:], -60000, 120000).astype(np.int32)
            cv2.fillConvexPoly(self.cast, cv2.convexHull(flat), 255, cv2.LINE_8, SUBPIXEL_BITS)
            return
        if points[:, 2].max() < NEAR_PLANE_M:
            return
        ground = (points - self.offset) @ self.from_mask
        order = cv2.convexHull(ground.astype(np.float32), returnPoints=False)[:, 0]
        self.lay(self.cast, points[order], 255)

    def outside(self, pose: Pose, reach: float) -> bool:
        """Whether nothing near the pose can reach the image."""
        x, y = pose.x - self.target.ego.x, pose.y - self.target.ego.y
        forward = math.cos(self.target.ego.heading) * x + math.sin(self.target.ego.heading) * y
        right = math.sin(self.target.ego.heading) * x - math.cos(self.target.ego.heading) * y
        half = self.target.camera.width / (2.0 * self.target.camera.intrinsics.fx)
        return forward < -reach or forward > SHADOWS_M or abs(right) > half * max(forward, 0.0) + 2.0 * reach

    def apply(self) -> None:
        """Blur and multiply onto the image."""
        image = self.target.image[self.top :]
        size = (image.shape[1], image.shape[0])
        contact = cv2.GaussianBlur(self.contact, (0, 0), 2.6 * image.shape[1] / 960.0 * 2 / SHRINK)
        cast = cv2.GaussianBlur(self.cast, (0, 0), 1.3 * image.shape[1] / 960.0 * 2 / SHRINK)
        light = (255.0 - cast * np.float32(self.target.light.shadow)) * (1.0 - contact * np.float32(0.85 / 255.0))
        kept = cv2.cvtColor(
            cv2.resize(light.astype(np.uint8), size, interpolation=cv2.INTER_LINEAR), cv2.COLOR_GRAY2BGR
        )
        cv2.multiply(image, kept, dst=image, scale=1.0 / 255.0)


def rectangle(length: float, width: float) -> FloatArray:
    """Corners [4, 2] of a rectangle around the origin, forward and right."""
    x, y = length / 2, width / 2
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
