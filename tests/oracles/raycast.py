"""Ray casting, slow and obvious, in float64: what `fsmsm_jax.raycast` must agree with.

Grids are crossed one cell at a time (J. Amanatides and A. Woo, Eurographics 1987):
no clearance, no jumps. Walls are met where their two ends lie on different sides of
the ray. Neither shares a formula with the package.
"""

import numpy as np


def cast_cells(stops, starts, headings, limit):
    """Distances to the entry face of the first stopping cell, all in cell units.

    Args:
        stops: (height, width) bool, row 0 at the bottom.
        starts: (rays, 2) positions as (column, row).
        headings: (rays,) directions in the grid's frame [rad].
        limit: distance at which to give up.

    Returns:
        (rays,) distances; 0 from inside a stopping cell, `limit` where the ray leaves
        the grid or meets nothing, or starts outside.
    """
    height, width = stops.shape
    d = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    step = np.where(d > 0, 1, -1)
    cell = np.floor(starts).astype(int)
    with np.errstate(divide="ignore"):
        per_cell = 1 / np.abs(d)
        to_face = np.where(d > 0, cell + 1 - starts, starts - cell) * per_cell
    t = np.zeros(len(starts))
    result = np.full(len(starts), float(limit))
    going = np.arange(len(starts))
    while going.size:
        column, row = cell[going].T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        going, column, row = going[inside], column[inside], row[inside]
        near = t[going] < limit
        going, column, row = going[near], column[near], row[near]
        hit = stops[row, column]
        result[going[hit]] = t[going[hit]]
        going = going[~hit]
        axis = np.argmin(to_face[going], axis=1)
        t[going] = to_face[going, axis]
        to_face[going, axis] += per_cell[going, axis]
        cell[going, axis] += step[going, axis]
    return result


def cast_grid(stops, resolution, origin, poses, bearings, limit, aside=0.0):
    """Ranges [m] of the rays `bearings` from `poses`, as `cast_cells` sees them.

    Args:
        stops: (height, width) bool, row 0 at the bottom.
        resolution: side of a cell [m].
        origin: (3,) pose of the grid's lower left corner in the map.
        poses: (rays, 3) one pose a ray, in the map.
        bearings: (rays,) one bearing a ray [rad].
        limit: largest range [m].
        aside: shift of every ray to its left [cells], to learn what a rounding
            error could have met instead.
    """
    x, y, yaw = np.asarray(origin, float)
    c, s = np.cos(yaw), np.sin(yaw)
    ahead = (poses[:, :2] - [x, y]) @ np.array([[c, -s], [s, c]]) / resolution
    headings = poses[:, 2] + bearings - yaw
    left = np.stack([-np.sin(headings), np.cos(headings)], axis=-1)
    starts = ahead + aside * left
    return cast_cells(stops, starts, headings, limit / resolution) * resolution


def cast_walls(start, end, position, headings, limit):
    """Ranges [m] to the nearest of the walls `start`..`end` (walls, 2) from a position."""
    result = np.full(len(headings), float(limit))
    for ray, heading in enumerate(headings):
        d = np.array([np.cos(heading), np.sin(heading)])
        a, b = start - position, end - position
        left_a = d[0] * a[:, 1] - d[1] * a[:, 0]
        left_b = d[0] * b[:, 1] - d[1] * b[:, 0]
        crossed = (left_a <= 0) != (left_b <= 0)
        share = left_a[crossed] / (left_a[crossed] - left_b[crossed])
        met = a[crossed] + share[:, None] * (b[crossed] - a[crossed])
        ranges = met @ d
        result[ray] = min([limit, *ranges[ranges >= 0]])
    return result
