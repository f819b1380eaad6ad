"""Articulated pedestrians and cyclists drawn from shaded limbs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import NEAR_PLANE_M
from cable_rpc.data.synthetic.raster import (
    SUBPIXEL_BITS,
    Target,
    Window,
    composite,
    haze,
    inside_image,
    window_around,
)
from cable_rpc.data.synthetic.road import Pose
from cable_rpc.data.synthetic.scenario import bgr

FloatArray = npt.NDArray[np.float64]
UInt8Array = npt.NDArray[np.uint8]

SKINS = tuple(bgr(*rgb) for rgb in ((228, 184, 154), (198, 150, 118), (150, 104, 76), (92, 62, 46), (240, 200, 172)))
HAIRS = tuple(bgr(*rgb) for rgb in ((34, 26, 22), (78, 52, 32), (150, 112, 60), (120, 116, 112), (20, 20, 22)))
COATS = tuple(
    bgr(*rgb)
    for rgb in (
        (34, 40, 56),
        (60, 62, 66),
        (150, 40, 44),
        (44, 84, 126),
        (196, 190, 176),
        (74, 92, 62),
        (190, 140, 60),
        (90, 60, 84),
        (28, 28, 32),
        (120, 140, 150),
        (222, 222, 220),
        (46, 110, 104),
    )
)
TROUSERS = tuple(bgr(*rgb) for rgb in ((40, 50, 76), (34, 34, 38), (92, 84, 70), (64, 74, 96), (120, 110, 92)))
SHOE = bgr(30, 28, 28)
TYRE = bgr(28, 28, 30)
LIT_SIDE_PIXELS = 2.0
"""Radius of the thickest limb from which its lit side is told apart."""
FAR_M = 30.0
FAR_PHASES = 16


@dataclass(frozen=True, slots=True)
class Look:
    """Build and clothing of one person."""

    height: float
    girth: float
    skin: FloatArray
    hair: FloatArray
    coat: FloatArray
    trousers: FloatArray
    bag: FloatArray | None
    helmet: FloatArray
    frame: FloatArray
    long_coat: bool
    long_hair: bool
    far_poses: dict[tuple[float, int], list[Limb]] = field(default_factory=dict, repr=False)
    """Walking limbs by stride and rounded phase, as seen from afar."""


@dataclass(frozen=True, slots=True)
class Limb:
    """A tapered capsule between two points in object axes, or a ring (a wheel) where `ring` is set."""

    start: FloatArray
    stop: FloatArray
    start_radius: float
    stop_radius: float
    colour: FloatArray
    ring: bool = False


def draw_look(rng: np.random.Generator) -> Look:
    """A random person."""

    def pick(choices: tuple[FloatArray, ...]) -> FloatArray:
        return choices[int(rng.integers(len(choices)))] * float(rng.uniform(0.85, 1.12))

    return Look(
        float(rng.uniform(1.55, 1.9)),
        float(rng.uniform(0.9, 1.2)),
        pick(SKINS),
        pick(HAIRS),
        pick(COATS),
        pick(TROUSERS),
        pick(COATS) if rng.random() < 0.45 else None,
        pick(COATS),
        pick(COATS),
        bool(rng.random() < 0.3),
        bool(rng.random() < 0.45),
    )


def vec(x: float, y: float, z: float) -> FloatArray:
    """A point in object axes."""
    return np.array([x, y, z])


def knee(hip: FloatArray, ankle: FloatArray, thigh: float, shin: float, forward: float) -> FloatArray:
    """Knee (or elbow) position of a two-bone limb, bent towards +x for forward > 0."""
    axis = ankle - hip
    span = min(float(np.linalg.norm(axis)), (thigh + shin) * 0.999)
    along = (thigh**2 - shin**2 + span**2) / (2.0 * span)
    out = math.sqrt(max(thigh**2 - along**2, 0.0))
    unit = axis / max(float(np.linalg.norm(axis)), 1e-9)
    bend = np.array([forward, 0.0, 0.0]) - forward * unit[0] * unit
    bend = bend / max(float(np.linalg.norm(bend)), 1e-9)
    joint: FloatArray = hip + unit * along + bend * out
    return joint


def head_limbs(look: Look, neck: FloatArray, lean: float, helmet: bool) -> list[Limb]:
    """Neck, head, hair or helmet above a neck point."""
    g = look.height
    crown = neck + vec(lean, 0, 0.13 * g)
    limbs = [
        Limb(neck, neck + vec(lean * 0.5, 0, 0.06 * g), 0.034 * g, 0.032 * g, look.skin * 0.85),
        Limb(
            neck + vec(lean + 0.012 * g, 0, 0.075 * g),
            crown + vec(0.01 * g, 0, -0.025 * g),
            0.044 * g,
            0.054 * g,
            look.skin,
        ),
    ]
    top = look.helmet if helmet else look.hair
    limbs.append(Limb(crown + vec(-0.02 * g, 0, 0.0), crown + vec(0.006 * g, 0, 0.01 * g), 0.055 * g, 0.056 * g, top))
    if look.long_hair and not helmet:
        limbs.append(Limb(crown + vec(-0.03 * g, 0, 0), neck + vec(-0.035 * g, 0, 0.0), 0.05 * g, 0.036 * g, look.hair))
    return limbs


def walking_limbs(look: Look, phase: float, stride: float) -> list[Limb]:
    """A person in the given phase (radians) of the gait; stride 0 stands, 1 walks."""
    g, wide = look.height, look.girth
    sway = 0.012 * g * math.cos(2 * phase) * stride
    hip_z, shoulder_z = 0.50 * g + sway, 0.80 * g + sway
    limbs: list[Limb] = []
    for side, offset in ((-1.0, 0.0), (1.0, math.pi)):
        swing = phase + offset
        foot_x = 0.19 * g * math.sin(swing) * stride
        lift = max(0.0, math.cos(swing)) * 0.075 * g * stride
        hip = vec(0, side * 0.052 * g * wide, hip_z)
        ankle = vec(foot_x, side * 0.05 * g, 0.045 * g + lift)
        joint = knee(hip, ankle, 0.245 * g, 0.235 * g, 1.0)
        limbs.append(Limb(hip, joint, 0.058 * g * wide, 0.040 * g, look.trousers))
        limbs.append(Limb(joint, ankle, 0.039 * g, 0.026 * g, look.trousers * 0.92))
        limbs.append(
            Limb(
                ankle + vec(-0.02 * g, 0, -0.018 * g), ankle + vec(0.085 * g, 0, -0.026 * g), 0.026 * g, 0.02 * g, SHOE
            )
        )
        arm = -0.75 * math.sin(swing) * stride * 0.6
        shoulder = vec(0, side * 0.115 * g * wide, shoulder_z)
        elbow = shoulder + vec(0.16 * g * math.sin(arm), side * 0.018 * g, -0.16 * g * math.cos(arm))
        hand = elbow + vec(0.15 * g * math.sin(arm + 0.35), -side * 0.004 * g, -0.14 * g * math.cos(arm + 0.35))
        limbs.append(Limb(shoulder, elbow, 0.036 * g * wide, 0.030 * g, look.coat * 0.94))
        limbs.append(Limb(elbow, hand, 0.029 * g, 0.023 * g, look.coat * 0.9))
        limbs.append(Limb(hand, hand + vec(0, 0, -0.03 * g), 0.021 * g, 0.017 * g, look.skin))
        flank = side * 0.042 * g * wide
        bottom = 0.36 * g if look.long_coat else 0.485 * g
        limbs.append(
            Limb(vec(0, flank, bottom), vec(0, flank, 0.66 * g), 0.062 * g * wide, 0.058 * g * wide, look.coat)
        )
        limbs.append(
            Limb(
                vec(0, flank, 0.66 * g),
                vec(0, side * 0.064 * g * wide, shoulder_z - 0.01 * g),
                0.058 * g * wide,
                0.05 * g * wide,
                look.coat,
            )
        )
    limbs.append(Limb(vec(0, 0, 0.5 * g), vec(0, 0, shoulder_z), 0.06 * g, 0.062 * g, look.coat * 0.97))
    if look.bag is not None:
        limbs.append(Limb(vec(-0.095 * g, 0, 0.62 * g), vec(-0.085 * g, 0, 0.76 * g), 0.075 * g, 0.06 * g, look.bag))
    return limbs + head_limbs(look, vec(0.0, 0, 0.82 * g + sway), 0.012 * g, False)


def far_walking_limbs(look: Look, phase: float, stride: float) -> list[Limb]:
    """`walking_limbs` in the nearest of a few phases, each built once."""
    step = round(phase / (2.0 * math.pi) * FAR_PHASES) % FAR_PHASES
    key = (stride, step)
    if key not in look.far_poses:
        look.far_poses[key] = walking_limbs(look, step * 2.0 * math.pi / FAR_PHASES, stride)
    return look.far_poses[key]


def draw_walker(target: Target, look: Look, phase: float, stride: float, pose: Pose, ident: int) -> float:
    """Draw a person on foot; returns the projected area in pixels, image border ignored."""
    far = math.hypot(pose.x - target.ego.x, pose.y - target.ego.y) > FAR_M
    limbs = far_walking_limbs(look, phase, stride) if far else walking_limbs(look, phase, stride)
    return draw_limbs(target, limbs, pose, ident)


def cycling_limbs(look: Look, crank: float) -> list[Limb]:
    """A rider on a bicycle with the crank at an angle (radians); the wheels touch z = 0."""
    g, radius = look.height, 0.34
    back, front = vec(-0.52, 0, radius), vec(0.55, 0, radius)
    pedal, seat, bar = vec(-0.06, 0, 0.29), vec(-0.22, 0, 0.93), vec(0.38, 0, 1.02)
    head = vec(0.40, 0, 0.82)
    limbs = [Limb(wheel, wheel, radius, 0.0, TYRE, ring=True) for wheel in (back, front)]
    tubes = ((back, pedal), (back, seat), (pedal, seat), (pedal, head), (seat, head), (head, bar), (head, front))
    limbs += [Limb(a, b, 0.018, 0.018, look.frame) for a, b in tubes]
    limbs.append(Limb(seat + vec(-0.1, 0, 0.03), seat + vec(0.12, 0, 0.03), 0.045, 0.03, SHOE))
    limbs.append(Limb(bar + vec(0, -0.24, 0), bar + vec(0, 0.24, 0), 0.016, 0.016, SHOE))
    hip_z = seat[2] + 0.09
    shoulder = vec(0.12, 0, hip_z + 0.285 * g)
    for side, offset in ((-1.0, 0.0), (1.0, math.pi)):
        angle = crank + offset
        foot = pedal + vec(0.165 * math.cos(angle), side * 0.11, -0.165 * math.sin(angle) + 0.05)
        hip = vec(seat[0] + 0.02, side * 0.08, hip_z)
        joint = knee(hip, foot, 0.25 * g, 0.245 * g, 1.0)
        limbs.append(Limb(hip, joint, 0.06 * g, 0.042 * g, look.trousers))
        limbs.append(Limb(joint, foot, 0.04 * g, 0.027 * g, look.trousers * 0.92))
        limbs.append(Limb(foot + vec(-0.04, 0, -0.03), foot + vec(0.14, 0, -0.04), 0.045, 0.035, SHOE))
        top = shoulder + vec(0, side * 0.11 * g * look.girth, 0)
        hand = bar + vec(0.02, side * 0.22, 0.02)
        elbow = knee(top, hand, 0.165 * g, 0.17 * g, -0.4)
        limbs.append(Limb(top, elbow, 0.036 * g, 0.031 * g, look.coat * 0.94))
        limbs.append(Limb(elbow, hand, 0.03 * g, 0.024 * g, look.coat * 0.9))
        limbs.append(Limb(hand, hand + vec(0.02, 0, 0), 0.042, 0.036, look.skin))
        flank = side * 0.045 * g * look.girth
        limbs.append(
            Limb(
                vec(seat[0], flank, hip_z), shoulder + vec(-0.02, flank * 1.25, -0.02), 0.066 * g, 0.054 * g, look.coat
            )
        )
    limbs.append(Limb(vec(seat[0], 0, hip_z), shoulder, 0.066 * g, 0.06 * g, look.coat * 0.97))
    if look.bag is not None:
        limbs.append(
            Limb(
                vec(seat[0] - 0.1, 0, hip_z + 0.12 * g), shoulder + vec(-0.14, 0, -0.03), 0.075 * g, 0.065 * g, look.bag
            )
        )
    return limbs + head_limbs(look, shoulder + vec(0.04, 0, 0.02), 0.03 * g, True)


def draw_limbs(target: Target, limbs: list[Limb], pose: Pose, ident: int) -> float:
    """Draw limbs far to near; returns the projected area in pixels, image border ignored."""
    ends = np.array([[limb.start, limb.stop] for limb in limbs]).reshape(-1, 3)
    camera_points = target.camera.to_camera(target.ego.to_local(pose.to_world(ends)))
    if camera_points[:, 2].min() < NEAR_PLANE_M:
        return 0.0
    focal = target.camera.intrinsics.fx
    pixels = target.camera.image_points(camera_points).reshape(-1, 2, 2)
    depth = camera_points[:, 2].reshape(-1, 2)
    radii = np.array([[limb.start_radius, limb.stop_radius] for limb in limbs]) * focal / depth
    reach = np.maximum(radii.max(axis=1), 0.5)
    corners = np.vstack(
        [(pixels - reach[:, None, None]).reshape(-1, 2), (pixels + reach[:, None, None]).reshape(-1, 2)]
    )
    extent = float((corners.max(axis=0) - corners.min(axis=0)).max())
    scale = 4 if extent < 70 else 3 if extent < 110 else 2
    window = window_around(target, corners, scale)
    area = 0.0
    inside = inside_image(target.camera, corners)
    if not inside:
        low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        whole = Window(int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1, 1)
        layer = whole.blank()
        paint_limbs(target, layer, whole, limbs, pixels, radii, depth, pose)
        area = float(np.count_nonzero(layer[..., 3] >= 128))
    if window is None:
        return area
    layer = window.blank()
    paint_limbs(target, layer, window, limbs, pixels, radii, depth, pose)
    covered = composite(target, window, layer, ident)
    return float(covered) if inside else area


def paint_limbs(
    target: Target,
    layer: UInt8Array,
    window: Window,
    limbs: list[Limb],
    pixels: FloatArray,
    radii: FloatArray,
    depth: FloatArray,
    pose: Pose,
) -> None:
    """Fill the limbs into a window, each with a lit and a shaded side."""
    light = target.light
    relative = pose.heading - target.ego.heading
    sun_right = (
        math.sin(target.ego.heading) * light.sun_direction[0] - math.cos(target.ego.heading) * light.sun_direction[1]
    )
    toward = np.array([math.copysign(0.38, sun_right), -0.22])
    base, lit = light.sky * 0.62 + light.bounce * 0.38, light.sky * 0.8 + light.bounce * 0.2 + light.sun * 0.75
    means = depth.mean(axis=1)
    passes = ((1.0, base), (0.62, lit)) if float(radii.max()) > LIT_SIDE_PIXELS else ((1.0, (base + lit) / 2),)
    albedo = np.array([limb.colour for limb in limbs])
    drawn = []
    for share, received in passes:
        shift = toward * radii[:, :, None] * (1.0 - share)
        outlines = window.pixels(capsules(pixels + shift, radii * share, 0.3 / window.scale))
        colours = np.clip(haze(albedo * received, light, float(means.mean())), 0, 255)
        drawn.append((outlines, np.column_stack([colours, np.full(len(limbs), 255.0)]).tolist()))
    for index in np.argsort(-means, kind="stable").tolist():
        limb = limbs[index]
        if limb.ring:
            paint_wheel(target, layer, window, limb, pixels[index, 0], float(radii[index, 0]), relative)
            continue
        for outlines, paints in drawn:
            cv2.fillConvexPoly(layer, outlines[index], paints[index], cv2.LINE_8, SUBPIXEL_BITS)


def capsules(ends: FloatArray, radii: FloatArray, least: float) -> FloatArray:
    """Outlines [N, 14, 2] of tapered capsules with ends [N, 2, 2] and radii [N, 2], in pixels."""
    axis = ends[:, 1] - ends[:, 0]
    angle = np.arctan2(axis[:, 1], axis[:, 0])[:, None]
    sweep = np.linspace(-math.pi / 2, math.pi / 2, 7)[None, :]
    sizes = np.maximum(radii, least)
    parts = []
    for end, turn in ((1, 0.0), (0, math.pi)):
        direction = angle + turn + sweep
        circle = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        parts.append(ends[:, end, None] + sizes[:, end, None, None] * circle)
    return np.concatenate(parts, axis=1)


def paint_wheel(
    target: Target, layer: UInt8Array, window: Window, limb: Limb, centre: FloatArray, radius: float, relative: float
) -> None:
    """A bicycle wheel: tyre, a hint of spokes, hub."""
    fixed = window.pixels(centre)
    # The wheel's plane holds its heading; seen along the view its width shrinks to a thin ellipse.
    bearing = (centre[0] - target.camera.intrinsics.cx) / target.camera.intrinsics.fx
    narrow = max(abs(math.sin(relative + math.atan(bearing))), 0.07)
    size = radius * window.scale
    axes = (max(int(size * narrow * 1.0), 1), max(int(size), 1))
    position = (int(fixed[0]) >> SUBPIXEL_BITS, int(fixed[1]) >> SUBPIXEL_BITS)
    colour = [*np.clip(limb.colour * target.light.ground, 0, 255).tolist(), 255.0]
    thick = max(1, round(size * 0.12))
    cv2.ellipse(layer, position, axes, 0.0, 0.0, 360.0, colour, thick, cv2.LINE_8)
    grey = [*(bgr(120, 122, 126) * target.light.ground).tolist(), 255.0]
    for spoke in range(4):
        angle = spoke * math.pi / 4
        dx, dy = int(axes[0] * math.cos(angle)), int(axes[1] * math.sin(angle))
        start, stop = (position[0] - dx, position[1] - dy), (position[0] + dx, position[1] + dy)
        cv2.line(layer, start, stop, grey, max(1, round(size * 0.02)))
