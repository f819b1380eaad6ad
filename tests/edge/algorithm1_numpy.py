"""The paper's Algorithm 1 on whole frames in plain NumPy: the equations vectorised one by one, in float64.

No OpenCV and nothing from the package. Each step is a function of its own. ``p`` holds the paper's parameters
under its own names, as in ``algorithm1_reference.PAPER``.
"""

from __future__ import annotations

import math

import numpy as np

TIE = 1e-9
"""Rows are rounded half up; float64 must not decide a tie that fractions would have exactly."""


def grey(image):
    """BT.601 luma, float64 [H, W], rounded to whole levels, of a BGR image uint8 [H, W, 3]."""
    blue, green, red = (image[:, :, channel].astype(np.float64) for channel in range(3))
    return np.floor(0.114 * blue + 0.587 * green + 0.299 * red + 0.5)


def shift_of(speed_mps, lateral_mps, fx, dt, eps):
    """t_x of H_k, pixels to the right."""
    return -fx * lateral_mps * dt / max(abs(speed_mps * dt), eps)


def warp_mask(mask, t):
    """Mhat: each pixel of the new view takes the nearest one of the old view, or nothing."""
    height, width = mask.shape
    y, x = np.indices((height, width))
    source = np.floor(x - t + 0.5)
    inside = (source >= 0) & (source < width)
    return inside & mask[y, np.where(inside, source, 0).astype(np.int64)]


def warp_grey(picture, t):
    """Ihat by linear interpolation between two columns, float64 [H, W], and where it is defined."""
    height, width = picture.shape
    y, x = np.indices((height, width))
    source = x - t
    valid = (source >= 0) & (source <= width - 1)
    source = np.where(valid, source, 0.0)
    left = np.floor(source).astype(np.int64)
    right = np.minimum(left + 1, width - 1)
    share = source - left
    return np.where(valid, (1 - share) * picture[y, left] + share * picture[y, right], 0.0), valid


def residual(picture, warped, valid, tau_e):
    """D_k = 1[E_k > tau_e], E_k = 0 where the warp is undefined."""
    difference = np.where(valid, np.abs(picture - warped), 0.0)
    return difference > tau_e


def dilation_radius(displacement_m, yaw_change_deg, p):
    """b_k."""
    return p["b_0"] + p["alpha"] * displacement_m + p["beta"] * abs(yaw_change_deg)


def ellipse_offsets(radius):
    """(dy, dx) of a disc: in row dy, as far as the rounded half chord."""
    for dy in range(-radius, radius + 1):
        half_chord = int(np.rint(math.sqrt(radius * radius - dy * dy)))
        for dx in range(-half_chord, half_chord + 1):
            yield dy, dx


def dilate(mask, b):
    """Mplus: the mask moved by every offset of the kernel, and all of that together."""
    height, width = mask.shape
    out = np.zeros((height, width), np.bool_)
    for dy, dx in ellipse_offsets(math.ceil(b)):
        rows, columns = height - abs(dy), width - abs(dx)
        if rows > 0 and columns > 0:
            to_y, to_x, from_y, from_x = max(dy, 0), max(dx, 0), max(-dy, 0), max(-dx, 0)
            out[to_y : to_y + rows, to_x : to_x + columns] |= mask[from_y : from_y + rows, from_x : from_x + columns]
    return out


def fuse(warped, dilated, motion):
    """Rraw_k."""
    return warped | (dilated & motion)


def smooth(values, window):
    """Moving average; the ends are replicated."""
    half = window // 2
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    return np.array([padded[i : i + window].mean() for i in range(len(values))])


def corridor(raw, p):
    """R_k = fill(t', b') ∪ Rraw_k, column by column."""
    height = raw.shape[0]
    out = raw.copy()
    occupied = [x for x in range(raw.shape[1]) if raw[:, x].any()]
    if not occupied:
        return out
    rows = [np.flatnonzero(raw[:, x]) for x in occupied]
    columns = np.arange(occupied[0], occupied[-1] + 1)
    t = np.interp(columns, occupied, [float(column[0]) for column in rows])
    b = np.interp(columns, occupied, [float(column[-1]) for column in rows])
    upper_curve = smooth(t, p["w_s"]) - float(p["eta_t"]) * t
    lower_curve = smooth(b, p["w_s"]) + float(p["eta_b"]) * (height - b)
    least = float(p["h_min"]) * height
    for x, upper, lower in zip(columns, upper_curve, lower_curve, strict=True):
        upper, lower = min(max(upper, 0.0), height - 1.0), min(max(lower, 0.0), height - 1.0)
        if lower - upper < least:
            centre = (upper + lower) / 2
            upper, lower = centre - least / 2, centre + least / 2
            if upper < 0:
                upper, lower = 0.0, lower - upper
            elif lower > height - 1:
                upper, lower = upper - (lower - (height - 1)), height - 1.0
            upper, lower = max(upper, 0.0), min(lower, height - 1.0)
        out[math.floor(upper + 0.5 + TIE) : math.floor(lower + 0.5 + TIE) + 1, x] = True
    return out


def coverage(region):
    """rho_k."""
    return region.sum() / region.size


def iou(a, b):
    """0 where both are empty."""
    union = (a | b).sum()
    return (a & b).sum() / union if union else 0.0


def algorithm1(greys, egos, fx, dt, cloud, p):
    """Yield (k, c_k, R_k, Rraw_k, b_k) for k >= 1; ``cloud(k, region)`` is F(I_k), cut to a region or not."""
    mask = cloud(0, None)
    keyframe = False
    for k in range(1, len(greys)):
        ego = egos[k]
        t = shift_of(ego.speed_mps, ego.lateral_mps, fx, dt, p["eps"])
        prior = warp_mask(mask, t)
        warped, valid = warp_grey(greys[k - 1].astype(np.float64), t)
        motion = residual(greys[k].astype(np.float64), warped, valid, p["tau_e"])
        displacement_m = math.hypot(ego.speed_mps, ego.lateral_mps) * dt
        b_k = dilation_radius(displacement_m, math.degrees(ego.yaw_rate_radps * dt), p)
        raw = fuse(prior, dilate(prior, b_k), motion)
        region = corridor(raw, p)
        yield k, keyframe, region, raw, b_k
        mask = cloud(k, None if keyframe else region)
        keyframe = bool(coverage(region) < float(p["tau_min"]) or iou(prior, mask) < float(p["tau_iou"]))
