"""Alignment as one would do it by hand: loops over rays and shifts, in float64.

Written from the definitions (thesis eq. 4.20, 4.30, 6.32 and errata E1, E9, E11), not
from the package: no FFT, no closed forms.
"""

import cmath
import math

import numpy as np


def first_harmonic(x):
    n_s = len(x)
    return sum(x[n] * cmath.exp(-2j * math.pi * n / n_s) for n in range(n_s))


def correlation(r, v):
    n_s = len(r)
    return np.array(
        [sum(r[n] * v[(n + k) % n_s] for n in range(n_s)) for k in range(n_s)]
    )


def procrustes_traces(r, v):
    """Largest trace tr(R P_V^k P_R^T) over the rotations R, by one SVD a shift k."""
    n_s = len(r)
    bearings = [2 * math.pi * n / n_s - math.pi for n in range(n_s)]
    directions = np.array(
        [[math.cos(a) for a in bearings], [math.sin(a) for a in bearings]]
    )
    points_r, points_v = r * directions, v * directions
    traces = []
    for k in range(n_s):
        U, D, Vt = np.linalg.svd(np.roll(points_v, -k, axis=1) @ points_r.T)
        traces.append(D[0] + np.linalg.det(U @ Vt) * D[1])
    return np.array(traces)


def bisect(r, nu):
    """Sinis: nu times, a ray of the mean range between every two neighbours."""
    for _ in range(nu):
        r = [x for n in range(len(r)) for x in (r[n], (r[n] + r[(n + 1) % len(r)]) / 2)]
    return r


def squared_difference(r, mask_r, v, mask_v):
    """Sum of squares and number of rays compared, at every shift."""
    n_s = len(r)
    total, count = np.zeros(n_s), np.zeros(n_s, int)
    for k in range(n_s):
        for n in range(n_s):
            if mask_r[n] and mask_v[(n + k) % n_s]:
                total[k] += (r[n] - v[(n + k) % n_s]) ** 2
                count[k] += 1
    return total, count


def position_step(ranges, mask, virtual, theta):
    """Half of the least-squares displacement that explains the differences."""
    n_s = len(ranges)
    angles = [theta - math.pi + 2 * math.pi * n / n_s for n in range(n_s) if mask[n]]
    directions = np.array([[math.cos(a), math.sin(a)] for a in angles])
    differences = np.array([virtual[n] - ranges[n] for n in range(n_s) if mask[n]])
    return 0.5 * np.linalg.lstsq(directions, differences, rcond=None)[0]


def caer(ranges, virtual, mask):
    return sum(abs(r - v) for r, v, m in zip(ranges, virtual, mask, strict=True) if m)
