"""Colours of the ground as a function of road coordinates: asphalt, markings, kerbs, slabs, grass."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from cable_rpc.data.synthetic.road import Road
from cable_rpc.data.synthetic.scenario import Light, Street, bgr
from cable_rpc.data.synthetic.textures import sample_wrapped, tileable_noise
from cable_rpc.data.synthetic.traffic import Crossing

Float32Array = npt.NDArray[np.float32]
UInt8Array = npt.NDArray[np.uint8]

NODES = 9
PATCH_CELL_M = 14.0
KERB_M = 0.16
FINEST_REPAIR_M = 0.1
VERGE_FRAY_M = 1.2
TRACK_STEPS = 1024
KERB = bgr(158, 156, 150)


def band(value: Float32Array, centre: float, half_width: float, texel: float) -> Float32Array:
    """Share of a texel covered by |value - centre| < half_width, in [0, 1]."""
    return np.clip((half_width - np.abs(value - centre)) / texel + 0.5, 0.0, 1.0)


def stripes(value: Float32Array, period: float, duty: float, texel: float) -> Float32Array:
    """Area-filtered periodic stripes: 1 inside the first `duty` metres of every period."""
    if texel > period * 0.7:
        return np.full_like(value, duty / period)
    phase = value - np.float32(period) * np.floor(value * np.float32(1.0 / period)) - np.float32(duty / 2)
    phase = np.minimum(np.abs(phase), np.abs(phase - np.float32(period)))
    return np.clip((duty / 2 - phase) / texel + 0.5, 0.0, 1.0)


def look_up(noise: Float32Array, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], period: float) -> Float32Array:
    """Noise with texels of `period` metres on the grid of world columns x [W] and rows y [H]."""
    size = noise.shape[0]
    columns = np.mod(x / period, size).astype(np.float32)[None, :]
    rows = np.mod(y / period, size).astype(np.float32)[:, None]
    shape = (rows.shape[0], columns.shape[1])
    return sample_wrapped(
        noise, np.ascontiguousarray(np.broadcast_to(columns, shape)), np.ascontiguousarray(np.broadcast_to(rows, shape))
    )


def wheel_tracks(street: Street) -> Float32Array:
    """Brightness change over the driven width, TRACK_STEPS + 1 values from the centre to the edge (0 beyond)."""
    d = np.arange(TRACK_STEPS + 1) * (street.lanes_each_way * street.lane_width / TRACK_STEPS)
    lane = np.mod(d, street.lane_width) - street.lane_width / 2
    change = 0.07 * np.exp(-(((np.abs(lane) - 0.75) / 0.3) ** 2)) - 0.08 * np.exp(-((lane / 0.28) ** 2))
    change[-1] = 0.0
    return np.asarray(change, np.float32)


class GroundPainter:
    """Paints square tiles of ground; the same world position always gets the same colour."""

    def __init__(
        self,
        rng: np.random.Generator,
        road: Road,
        street: Street,
        light: Light,
        crossings: tuple[Crossing, ...],
    ) -> None:
        self.road, self.street, self.light, self.crossings = road, street, light, crossings
        self.grain = tileable_noise(rng, 256, 0.35)
        self.cloud = tileable_noise(rng, 256, 1.3)
        self.patch_seed = int(rng.integers(2**31))
        tone = float(rng.uniform(0.8, 1.15))
        self.asphalt = bgr(88, 88, 90) * tone
        self.slab = bgr(150, 146, 138) * float(rng.uniform(0.8, 1.1))
        self.grass = bgr(92, 112, 52) * float(rng.uniform(0.85, 1.15))
        self.yellow = bgr(214, 164, 44)
        self.white = bgr(222, 222, 216)
        self.wear = float(rng.uniform(0.1, 0.45))
        self.tracks = wheel_tracks(street)
        self.edge_line = bool(rng.random() < 0.6) or not street.pavement

    @property
    def far_colour(self) -> UInt8Array:
        """Mean colour of the land away from the road, BGR [3]."""
        open_land = self.street.verge > 0 or self.street.houses
        return np.clip((self.grass if open_land else self.slab) * self.light.ground, 0, 255).astype(np.uint8)

    def paint(self, x0: float, y0: float, texel: float, size: int) -> UInt8Array:
        """A tile [size, size, 3] BGR whose first texel's corner lies at world (x0, y0)."""
        s, d = self.road_coordinates(x0, y0, texel, size)
        side = np.abs(d)
        grain, blotch = self.noises(x0, y0, texel, size)
        street = self.street
        half = street.road_half_width
        nearest, farthest = float(side.min()) - texel, float(side.max()) + texel
        tints: list[npt.NDArray[np.float64]] = []
        shares: list[Float32Array] = []
        # From the top layer down; `left` is the share of a texel that shows what lies below.
        left = np.ones_like(s)
        edge = half + KERB_M + street.pavement
        if (street.verge or street.houses) and farthest + VERGE_FRAY_M > edge:
            border = side + 0.12 * blotch + 0.08 * grain
            cover = np.clip((border - edge) / texel + 0.5, 0, 1)
            tints.append(self.grass)
            shares.append(cover * (1.0 + 0.16 * grain + 0.16 * blotch))
            left -= cover
        if street.pavement and farthest > half - 0.1 and left.any():
            left = self.lay_pavement(tints, shares, left, s, d, texel, grain, blotch)
        if nearest < half + 1.0 and left.any():
            white, yellow = self.markings(s, d, texel, blotch)
            bare = left * (1.0 - white)
            tints += [self.white, self.yellow, self.asphalt]
            shares += [left * white, bare * yellow]
            shares.append(bare * (1.0 - yellow) * self.asphalt_shade(s, d, texel, grain, blotch))
        elif left.any():
            tints.append(self.asphalt)
            shares.append(left)
        palette = (np.array(tints) * self.light.ground).astype(np.float32)
        colour = np.stack(shares, dtype=np.float32).reshape(len(shares), -1).T @ palette
        return np.asarray(cv2.convertScaleAbs(colour), np.uint8).reshape(size, size, 3)

    def lay_pavement(
        self,
        tints: list[npt.NDArray[np.float64]],
        shares: list[Float32Array],
        left: Float32Array,
        s: Float32Array,
        d: Float32Array,
        texel: float,
        grain: Float32Array,
        blotch: Float32Array,
    ) -> Float32Array:
        """Add slabs and kerb to the layers; returns what is left of `left` for the carriageway."""
        side, half = np.abs(d), self.street.road_half_width
        slabs: Float32Array = 1.0 + 0.07 * grain + 0.09 * blotch
        if texel < 0.07:
            slabs *= 1.0 - 0.28 * np.maximum(stripes(s, 0.9, 0.016, texel), stripes(d, 0.6, 0.016, texel))
        paved: Float32Array = np.clip((side - half - KERB_M) / texel + 0.5, 0, 1)
        tints.append(self.slab)
        shares.append(left * paved * slabs)
        left = left * (1.0 - paved)
        if float(side.min()) > half + KERB_M + texel:
            return left
        on_kerb = np.abs(side - half - KERB_M / 2) < KERB_M / 2
        joint: Float32Array = 1.0 - 0.35 * on_kerb.astype(np.float32) * stripes(s, 1.0, 0.02, texel)
        left = left * joint * (1.0 - 0.4 * band(side, half, 0.05, texel))
        kerb: Float32Array = np.clip((side - half) / texel + 0.5, 0, 1)
        tints.append(KERB)
        shares.append(left * kerb * (1.0 + 0.06 * grain))
        return np.asarray(left * (1.0 - kerb), np.float32)

    def road_coordinates(self, x0: float, y0: float, texel: float, size: int) -> tuple[Float32Array, Float32Array]:
        """Road coordinates s, d [size, size] of the texel centres, from a coarse exact grid."""
        span = (np.arange(NODES) + 0.5) / NODES * size * texel
        grid_x, grid_y = np.meshgrid(x0 + span, y0 + span)
        s, d = self.road.coordinates(np.column_stack([grid_x.ravel(), grid_y.ravel()]))
        along = cv2.resize(s.reshape(NODES, NODES), (size, size), interpolation=cv2.INTER_LINEAR)
        # cv2.resize replicates at the border, so the outer half cells are extended linearly.
        across = cv2.resize(d.reshape(NODES, NODES), (size, size), interpolation=cv2.INTER_LINEAR)
        margin = -(-size // (2 * NODES)) + 1
        return (
            extend(np.asarray(along, np.float64), margin).astype(np.float32),
            extend(np.asarray(across, np.float64), margin).astype(np.float32),
        )

    def noises(self, x0: float, y0: float, texel: float, size: int) -> tuple[Float32Array, Float32Array]:
        """Fine and coarse noise [size, size] with the share that a texel of this size still resolves."""
        steps = (np.arange(size, dtype=np.float64) + 0.5) * texel
        grain = np.zeros((size, size), np.float32)
        for period, weight in ((0.015, 0.9), (0.11, 0.8), (0.7, 0.7)):
            fade = min(1.0, 2.0 * period / texel)
            if fade > 0.15:
                grain += np.float32(weight * fade) * look_up(self.grain, x0 + steps, y0 + steps, period)
        blotch = look_up(self.cloud, x0 + steps, y0 + steps, 0.17)
        return grain, blotch

    def asphalt_shade(
        self, s: Float32Array, d: Float32Array, texel: float, grain: Float32Array, blotch: Float32Array
    ) -> Float32Array:
        """Brightness factor of the carriageway: grain, stains, wheel tracks, repairs."""
        street = self.street
        shade = 1.0 + 0.10 * grain + 0.07 * blotch
        place = np.abs(d) * np.float32(TRACK_STEPS / (street.lanes_each_way * street.lane_width))
        shade += self.tracks[np.minimum(place, TRACK_STEPS).astype(np.int16)]
        s_low, s_high, d_low, d_high = float(s.min()), float(s.max()), float(d.min()), float(d.max())

        def meets(centre_s: float, reach_s: float, centre_d: float, reach_d: float) -> bool:
            return (
                s_low - texel - reach_s < centre_s < s_high + texel + reach_s
                and d_low - texel - reach_d < centre_d < d_high + texel + reach_d
            )

        first, last = int(s_low // PATCH_CELL_M), int(s_high // PATCH_CELL_M)
        if texel < FINEST_REPAIR_M:
            for cell in range(first, last + 1):
                rng = np.random.default_rng([self.patch_seed, cell + 1000])
                for _ in range(int(rng.integers(0, 3))):
                    centre_s, centre_d = (cell + rng.random()) * PATCH_CELL_M, rng.uniform(-7, 7)
                    size_s, size_d = rng.uniform(0.5, 3.5), rng.uniform(0.25, 1.3)
                    tone = rng.uniform(-0.22, 0.12)
                    if not meets(centre_s, size_s, centre_d, size_d):
                        continue
                    inside = band(s, centre_s, size_s, texel) * band(d, centre_d, size_d, texel)
                    rim = inside - band(s, centre_s, size_s - 0.04, texel) * band(d, centre_d, size_d - 0.04, texel)
                    shade += tone * inside - 0.16 * rim
                if rng.random() < 0.4:
                    hole_s, hole_d = (cell + rng.random()) * PATCH_CELL_M, rng.uniform(-4, 4)
                    if meets(hole_s, 0.5, hole_d, 0.5):
                        radius = np.hypot(s - hole_s, d - hole_d)
                        shade += 0.12 * np.clip((0.34 - radius) / texel + 0.5, 0, 1)
                        shade -= 0.3 * np.clip((0.05 - np.abs(radius - 0.34)) / texel + 0.5, 0, 1)
                crack_s, crack_d = (cell + rng.random()) * PATCH_CELL_M, rng.uniform(-5, 5)
                if not meets(crack_s, 1.5, crack_d, 2.0):
                    continue
                path = np.abs(s - crack_s + 0.5 * np.sin(d * 2.1 + cell) + 0.15 * blotch)
                crack = np.clip((0.012 - path) / texel + 0.5, 0, 1) * (np.abs(d - crack_d) < 2.0)
                shade -= 0.25 * crack
        return np.maximum(shade, 0.2).astype(np.float32)

    def markings(
        self, s: Float32Array, d: Float32Array, texel: float, blotch: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """White and yellow shares of lane lines, edge lines, parking boxes, zebra crossings and stop lines."""
        street = self.street
        edge = street.lanes_each_way * street.lane_width
        white = np.zeros_like(s)
        yellow = np.zeros_like(s)
        centre = yellow if street.yellow_centre else white
        if street.lanes_each_way > 1 or street.name == "country":
            double = band(d, 0.13, 0.06, texel) + band(d, -0.13, 0.06, texel)
            np.maximum(centre, np.minimum(double, 1.0), out=centre)
        else:
            np.maximum(centre, band(d, 0.0, 0.06, texel) * stripes(s, 6.0, 3.0, texel), out=centre)
        side = np.abs(d)
        for lane in range(1, street.lanes_each_way):
            np.maximum(
                white, band(side, lane * street.lane_width, 0.06, texel) * stripes(s, 9.0, 3.0, texel), out=white
            )
        if self.edge_line:
            np.maximum(white, band(side, edge + 0.05, 0.06, texel), out=white)
        if street.parking:
            inner = street.road_half_width - street.parking
            boxes = stripes(s, 6.0, 0.1, texel) * (side > inner) * (side < street.road_half_width)
            np.maximum(white, boxes, out=white)
            np.maximum(white, 0.8 * band(side, inner, 0.05, texel) * stripes(s, 2.0, 1.0, texel), out=white)
        for crossing in self.crossings:
            if s.min() - 5 < crossing.s < s.max() + 5:
                zone = band(s, crossing.s, 3.2, texel)
                white *= 1.0 - zone
                yellow *= 1.0 - zone
                on_road = side < street.road_half_width - 0.2
                zebra = band(s, crossing.s, 1.6, texel) * stripes(d, 1.0, 0.5, texel) * on_road
                np.maximum(white, zebra, out=white)
                for direction in (1, -1):
                    own = (np.sign(d) == direction) & (side < edge)
                    line = band(s, crossing.s - direction * 3.0, 0.18, texel) * own
                    np.maximum(white, line, out=white)
        paint = 1.0 - self.wear * np.clip(0.7 + 0.7 * blotch, 0, 1)
        on_road = side < street.road_half_width
        paint *= on_road
        return np.asarray(white * paint, np.float32), np.asarray(yellow * paint, np.float32)


def extend(field: npt.NDArray[np.float64], margin: int) -> npt.NDArray[np.float64]:
    """Replace the replicated border of an upscaled field by linear extrapolation."""
    m = margin
    steps = np.arange(m, 0, -1.0)
    field[:, :m] = field[:, m : m + 1] - steps * (field[:, m + 1 : m + 2] - field[:, m : m + 1])
    field[:, -m:] = field[:, -m - 1 : -m] + steps[::-1] * (field[:, -m - 1 : -m] - field[:, -m - 2 : -m - 1])
    column = steps[:, None]
    field[:m] = field[m : m + 1] - column * (field[m + 1 : m + 2] - field[m : m + 1])
    field[-m:] = field[-m - 1 : -m] + column[::-1] * (field[-m - 1 : -m] - field[-m - 2 : -m - 1])
    return field
