"""Lamp posts, signs, bollards and other small things made of meshes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.mesh import Mesh, MeshBuilder
from cable_rpc.data.synthetic.occlusion import Occlusion, square
from cable_rpc.data.synthetic.raster import Target, draw_mesh
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.scenario import bgr
from cable_rpc.data.synthetic.shadows import ShadowLayer

FloatArray = npt.NDArray[np.float64]

STEEL = bgr(118, 122, 126)
NEAREST_M = 1.0


@dataclass(slots=True)
class Fixture:
    """A mesh that stands at a pose."""

    s: float
    pose: Pose
    mesh: Mesh
    width: float
    height: float

    def distance(self, ego: Pose, camera: Camera) -> float | None:
        """Distance of the foot."""
        cosine, sine = math.cos(ego.heading), math.sin(ego.heading)
        dx, dy = self.pose.x - ego.x, self.pose.y - ego.y
        forward, right = cosine * dx + sine * dy, sine * dx - cosine * dy
        half = camera.width / (2.0 * camera.intrinsics.fx)
        if forward < NEAREST_M or abs(right) > half * forward + 1.0 + 0.4 * self.height or forward > 26.0 * self.height:
            return None
        return math.hypot(forward, right)

    @property
    def anchor(self) -> tuple[float, float, float]:
        """World x and y, and the distance in metres within which it is seen."""
        return self.pose.x, self.pose.y, 1.0 + 0.4 * self.height

    @property
    def shadow_reach(self) -> float:
        """How far its shadow may fall, metres."""
        return max(self.width, self.height * 2)

    def shadow(self, shadows: ShadowLayer) -> None:
        """The shadow of a thin post."""
        shadows.add_box(self.pose, self.width, self.width, self.height)

    @property
    def space(self) -> tuple[FloatArray, float]:
        """Footprint [4, 2], world metres, and height that hold all of it."""
        return square(self.pose.x, self.pose.y, float(np.hypot(*self.mesh.corners[:2]).max())), float(
            self.mesh.corners[2].max()
        )

    def prepare(self, target: Target, occlusion: Occlusion) -> Callable[[], None]:
        """What draws it; it hides nothing behind it."""
        return partial(self.draw, target)

    def draw(self, target: Target) -> None:
        """Draw it."""
        draw_mesh(target, self.mesh, self.pose)


def post(builder: MeshBuilder, radius: float, low: float, high: float, colour: FloatArray) -> None:
    """An upright octagonal post around the origin."""
    angle = np.linspace(0, 2 * math.pi, 9)
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    for (x0, y0), (x1, y1) in pairwise(ring):
        quad = [[x0, y0, low], [x1, y1, low], [x1 * 0.7, y1 * 0.7, high], [x0 * 0.7, y0 * 0.7, high]]
        builder.add(quad, colour, gloss=0.2, normal=np.array([x0 + x1, y0 + y1, 0.0]))


def lamp_post(lit: bool) -> Mesh:
    """A street lamp whose arm reaches along +y."""
    builder = MeshBuilder(centre=np.array([0.0, 0.0, 4.0]))
    post(builder, 0.11, 0.0, 1.2, STEEL * 0.8)
    post(builder, 0.08, 1.2, 7.6, STEEL)
    builder.part = 1
    builder.box((-0.04, 0.0, 7.5), (0.04, 1.7, 7.6), STEEL)
    builder.box((-0.14, 1.3, 7.45), (0.14, 2.1, 7.62), STEEL * 1.2)
    glass = [[-0.11, 1.35, 7.44], [0.11, 1.35, 7.44], [0.11, 2.05, 7.44], [-0.11, 2.05, 7.44]]
    colour = bgr(255, 226, 170) if lit else bgr(200, 200, 196)
    builder.add(glass, colour, glow=float(lit), layer=2, normal=np.array([0.0, 0.0, -1.0]))
    return builder.build()


def sign(kind: int) -> Mesh:
    """A traffic sign that faces -x: 0 prohibition, 1 mandatory, 2 warning, 3 crossing, 4 parking."""
    builder = MeshBuilder(centre=np.zeros(3))
    post(builder, 0.035, 0.0, 2.7, STEEL)
    builder.part = 1
    sides, turn = {0: (16, 0.0), 1: (16, 0.0), 2: (3, math.pi / 2), 3: (4, math.pi / 4), 4: (4, math.pi / 4)}[kind]
    angle = np.arange(sides) * 2 * math.pi / sides + turn
    rim = {0: bgr(190, 30, 34), 1: bgr(28, 78, 160), 2: bgr(190, 30, 34), 3: bgr(28, 78, 160), 4: bgr(28, 78, 160)}[
        kind
    ]
    face = {
        0: bgr(236, 236, 232),
        1: bgr(28, 78, 160),
        2: bgr(236, 236, 232),
        3: bgr(236, 236, 232),
        4: bgr(236, 236, 232),
    }[kind]
    share = {0: 0.74, 1: 0.9, 2: 0.66, 3: 0.6, 4: 0.35}[kind]
    front = np.array([-1.0, 0.0, 0.0])

    def plate(radius: float, x: float) -> FloatArray:
        return np.column_stack([np.full(sides, x), radius * np.cos(angle), 2.5 + radius * np.sin(angle)])

    builder.add(plate(0.36, -0.04), rim, gloss=0.1, normal=front)
    builder.add(plate(0.36 * share, -0.05), face, layer=1, normal=front)
    builder.add(plate(0.36, -0.03), STEEL * 0.9, normal=-front)
    return builder.build()


def bollard() -> Mesh:
    """A roadside marker post."""
    builder = MeshBuilder(centre=np.array([0.0, 0.0, 0.5]))
    post(builder, 0.07, 0.0, 1.0, bgr(226, 226, 222))
    builder.part = 1
    post(builder, 0.062, 0.72, 0.92, bgr(30, 30, 32))
    return builder.build()


def bin_or_box(colour: FloatArray) -> Mesh:
    """A litter bin or a switch cabinet."""
    builder = MeshBuilder(centre=np.array([0.0, 0.0, 0.6]))
    builder.box((-0.25, -0.4, 0.0), (0.25, 0.4, 1.15), colour, gloss=0.1)
    builder.box((-0.28, -0.43, 1.1), (0.28, 0.43, 1.2), colour * 0.7, layer=1)
    return builder.build()
