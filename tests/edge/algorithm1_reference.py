"""The paper's Algorithm 1 with loops over pixels and exact fractions: slow, literal, independent."""

from __future__ import annotations

import math
from fractions import Fraction

import cv2
import numpy as np

PAPER = {
    "tau_e": 25,
    "tau_min": Fraction(2, 100),
    "tau_iou": Fraction(3, 10),
    "w_s": 15,
    "eta_t": Fraction(10, 100),
    "eta_b": Fraction(15, 100),
    "h_min": Fraction(1, 10),
    "b_0": 8.0,
    "alpha": 1.5,
    "beta": 20.0,
    "eps": 1e-6,
}


def shift_of(ego, fx, dt, eps):
    """t_x of H_k."""
    return -fx * ego.lateral_mps * dt / max(abs(ego.speed_mps * dt), eps)


def warp_mask(mask, t):
    width = mask.shape[1]
    out = np.zeros_like(mask)
    for x in range(width):
        source = math.floor(x - t + 0.5)
        if 0 <= source < width:
            out[:, x] = mask[:, source]
    return out


def warp_grey(grey, t):
    height, width = grey.shape
    out = np.zeros((height, width))
    valid = np.zeros((height, width), bool)
    for x in range(width):
        source = x - t
        if 0 <= source <= width - 1:
            left = math.floor(source)
            share = source - left
            right = min(left + 1, width - 1)
            out[:, x] = (1 - share) * grey[:, left] + share * grey[:, right]
            valid[:, x] = True
    return out, valid


def residual(grey, warped, valid, tau_e):
    out = np.zeros(grey.shape, bool)
    for y in range(grey.shape[0]):
        for x in range(grey.shape[1]):
            out[y, x] = valid[y, x] and abs(float(grey[y, x]) - warped[y, x]) > tau_e
    return out


def dilate(mask, b):
    radius = math.ceil(b)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    offsets = [
        (dy - radius, dx - radius) for dy in range(2 * radius + 1) for dx in range(2 * radius + 1) if kernel[dy, dx]
    ]
    height, width = mask.shape
    out = np.zeros_like(mask)
    for y, x in zip(*np.nonzero(mask), strict=True):
        for dy, dx in offsets:
            if 0 <= y + dy < height and 0 <= x + dx < width:
                out[y + dy, x + dx] = True
    return out


def smooth(values, window):
    half = window // 2
    last = len(values) - 1
    return [
        sum(values[min(max(i + j, 0), last)] for j in range(-half, half + 1)) / Fraction(window)
        for i in range(len(values))
    ]


def interpolate(known, first, last):
    """Piecewise linear through {column: row} for every column first..last."""
    columns = sorted(known)
    values = []
    for x in range(first, last + 1):
        if x in known:
            values.append(Fraction(known[x]))
            continue
        before = max(c for c in columns if c < x)
        after = min(c for c in columns if c > x)
        values.append(known[before] + Fraction(x - before, after - before) * (known[after] - known[before]))
    return values


def corridor(raw, p):
    height, width = raw.shape
    out = raw.copy()
    tops, bottoms = {}, {}
    for x in range(width):
        rows = [y for y in range(height) if raw[y, x]]
        if rows:
            tops[x], bottoms[x] = rows[0], rows[-1]
    if not tops:
        return out
    first, last = min(tops), max(tops)
    t = interpolate(tops, first, last)
    b = interpolate(bottoms, first, last)
    t_smooth, b_smooth = smooth(t, p["w_s"]), smooth(b, p["w_s"])
    for i in range(last - first + 1):
        upper = t_smooth[i] - p["eta_t"] * t[i]
        lower = b_smooth[i] + p["eta_b"] * (height - b[i])
        upper = min(max(upper, Fraction(0)), Fraction(height - 1))
        lower = min(max(lower, Fraction(0)), Fraction(height - 1))
        least = p["h_min"] * height
        if lower - upper < least:
            centre = (upper + lower) / 2
            upper, lower = centre - least / 2, centre + least / 2
            if upper < 0:
                upper, lower = Fraction(0), lower - upper
            elif lower > height - 1:
                upper, lower = upper - (lower - (height - 1)), Fraction(height - 1)
            upper, lower = max(upper, Fraction(0)), min(lower, Fraction(height - 1))
        for y in range(math.floor(upper + Fraction(1, 2)), math.floor(lower + Fraction(1, 2)) + 1):
            out[y, first + i] = True
    return out


def iou(a, b):
    union = (a | b).sum()
    return Fraction(int((a & b).sum()), int(union)) if union else Fraction(0)


def algorithm1(greys, egos, fx, dt, cloud, p):
    """Yield (k, c_k, R_k, Rraw_k, b_k) for k >= 1; ``cloud(k, region)`` is F(I_k), cut to a region or not."""
    mask = cloud(0, None)
    keyframe = False
    for k in range(1, len(greys)):
        t = shift_of(egos[k], fx, dt, p["eps"])
        prior = warp_mask(mask, t)
        warped, valid = warp_grey(greys[k - 1], t)
        motion = residual(greys[k], warped, valid, p["tau_e"])
        distance = math.hypot(egos[k].speed_mps, egos[k].lateral_mps) * dt
        b_k = p["b_0"] + p["alpha"] * distance + p["beta"] * abs(math.degrees(egos[k].yaw_rate_radps * dt))
        raw = prior | (dilate(prior, b_k) & motion)
        region = corridor(raw, p)
        yield k, keyframe, region, raw, b_k
        mask = cloud(k, None if keyframe else region)
        coverage = Fraction(int(region.sum()), region.size)
        keyframe = coverage < p["tau_min"] or iou(prior, mask) < p["tau_iou"]
