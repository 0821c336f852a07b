"""Alignment as one would do it by hand: loops over rays and shifts, in float64.

Written from the definitions (thesis eq. 4.30, 6.32 and errata E1, E9), not from the
package: no FFT, no closed forms.
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
