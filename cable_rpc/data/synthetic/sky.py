"""Sky, clouds and the far horizon as a panorama at infinity."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.scenario import Light, bgr
from cable_rpc.data.synthetic.textures import sample_wrapped, tileable_noise

Float32Array = npt.NDArray[np.float32]
UInt8Array = npt.NDArray[np.uint8]

PANORAMA_WIDTH = 2048
LOWEST_RAD = -0.06
HIGHEST_RAD = 1.0


class Sky:
    """Renders everything above the horizon; moves only with the heading."""

    def __init__(self, rng: np.random.Generator, camera: Camera, light: Light, skyline: float) -> None:
        """Paint the panorama; `skyline` is the typical height of the far silhouette in radians."""
        self.panorama = paint_panorama(rng, light, skyline)
        rows = min(camera.height, max(1, math.ceil(camera.horizon_row) + 2))
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(rows, dtype=np.float64))
        k = camera.intrinsics
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1)
        vehicle = rays @ camera.vehicle_to_camera
        azimuth = -np.arctan2(vehicle[..., 1], vehicle[..., 0])
        elevation = np.arctan2(vehicle[..., 2], np.hypot(vehicle[..., 0], vehicle[..., 1]))
        per_radian = PANORAMA_WIDTH / (2.0 * math.pi)
        self.columns = np.asarray(-azimuth * per_radian, dtype=np.float32)
        self.lines = np.asarray((HIGHEST_RAD - elevation) * per_radian, dtype=np.float32)

    def render(self, image: UInt8Array, heading: float) -> None:
        """Paint the rows above the horizon of `image` [H, W, 3]."""
        offset = -heading * PANORAMA_WIDTH / (2.0 * math.pi)
        reach = float(-self.columns.min()) + 2.0
        start = math.floor(offset - reach)
        width = math.ceil(2 * reach) + 4
        part = np.take(self.panorama, np.arange(start, start + width), axis=1, mode="wrap")
        columns = self.columns + np.float32(offset - start)
        image[: len(columns)] = cv2.remap(part, columns, self.lines, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def paint_panorama(rng: np.random.Generator, light: Light, skyline: float) -> UInt8Array:
    """The full circle of sky [rows, PANORAMA_WIDTH, 3]; columns run clockwise."""
    per_radian = PANORAMA_WIDTH / (2.0 * math.pi)
    rows = math.ceil((HIGHEST_RAD - LOWEST_RAD) * per_radian)
    elevation = (HIGHEST_RAD - np.arange(rows) / per_radian).astype(np.float32)[:, None]
    azimuth = (-np.arange(PANORAMA_WIDTH) / per_radian).astype(np.float32)[None, :]
    horizon, zenith = light.horizon.astype(np.float32), light.zenith.astype(np.float32)
    up = np.clip(np.sin(elevation), 0.0, 1.0)
    colour = horizon + (zenith - horizon) * (up**0.6)[..., None]
    colour = np.broadcast_to(colour, (rows, PANORAMA_WIDTH, 3)).astype(np.float32)
    noise = tileable_noise(rng, 512, 1.45)
    stretch = 62.0 / (up + 0.14)
    x, y = stretch * np.cos(azimuth), stretch * np.sin(azimuth)
    field = np.zeros((rows, PANORAMA_WIDTH), np.float32)
    for zoom, weight in ((1.0, 1.0), (3.1, 0.35)):
        wrapped = [np.mod(value * zoom, 512.0).astype(np.float32) for value in (x, y)]
        field += weight * sample_wrapped(noise, *wrapped)
    cover = np.clip((field - 1.1 + 2.2 * light.cloudiness) * 0.8, 0.0, 1.0)
    depth = np.clip(field * 0.25 + 0.5, 0.0, 1.0)
    lit = bgr(248, 246, 242) if light.name != "dusk" else bgr(232, 168, 132)
    dark = light.zenith * 0.45 + light.horizon * 0.45
    if light.name == "overcast":
        lit, dark = bgr(206, 210, 216), bgr(150, 156, 166)
    lit, dark = lit.astype(np.float32), dark.astype(np.float32)
    cloud = lit + (dark - lit) * depth[..., None]
    share = (cover * np.clip(up * 9.0, 0.0, 0.9))[..., None]
    colour = colour + share * (cloud - colour)
    sun_azimuth = math.atan2(light.sun_direction[1], light.sun_direction[0])
    sun_elevation = math.asin(float(light.sun_direction[2]))
    away = np.hypot(np.angle(np.exp(1j * (azimuth - sun_azimuth))) * math.cos(sun_elevation), elevation - sun_elevation)
    glow = 0.5 * np.exp(-((away / 0.35) ** 1.3)) * (0.0 if light.name == "overcast" else 1.0)
    colour += glow[..., None] * (np.array([225.0, 245.0, 255.0], np.float32) - colour)
    add_far_silhouettes(rng, colour, elevation[:, 0], light, skyline)
    return np.clip(colour, 0, 255).astype(np.uint8)


def add_far_silhouettes(
    rng: np.random.Generator,
    colour: npt.NDArray[np.floating],
    elevation: Float32Array,
    light: Light,
    skyline: float,
) -> None:
    """Hills, woods and roofs fading into the haze, far to near."""
    for layer, (share, tone) in enumerate(
        ((0.8, bgr(110, 124, 120)), (0.62, bgr(84, 100, 78)), (0.45, bgr(74, 84, 66)))
    ):
        spectrum = np.zeros(PANORAMA_WIDTH // 2 + 1, np.complex128)
        orders = np.arange(1, 241)
        spectrum[1:241] = (rng.standard_normal(240) + 1j * rng.standard_normal(240)) / orders**0.9
        ridge = np.fft.irfft(spectrum, n=PANORAMA_WIDTH)
        ridge = skyline * (0.95 - 0.22 * layer) * (1.0 + 0.28 * ridge / ridge.std())
        tint = tone * light.ground
        tint = tint + share * (light.horizon - tint)
        low = int(np.searchsorted(-elevation, -float(ridge.max()) - 0.01))
        inside = np.clip((ridge[None, :] - elevation[low:, None]) * PANORAMA_WIDTH / 6.28 + 0.5, 0.0, 1.0)
        rough = 1.0 + 0.06 * rng.standard_normal((len(elevation) - low, PANORAMA_WIDTH))
        rough = np.asarray(cv2.GaussianBlur(rough.astype(np.float32), (0, 0), 1.2))
        target = tint.astype(np.float32) * rough[..., None]
        colour[low:] += inside.astype(np.float32)[..., None] * (target - colour[low:])
