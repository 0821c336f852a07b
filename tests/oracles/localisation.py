"""Localisation as one would do it by hand, in float64: sums instead of transforms.

Written from the definitions in the package's docstrings, with no FFT and no derivative
but central differences.
"""

import numpy as np

from tests.oracles.raycast import cast_walls


def distance_to_walls(start, end, points):
    """Distances [m] from (n, 2) points to the nearest wall, by projection on each."""
    nearest = np.full(len(points), np.inf)
    for a, b in zip(start, end, strict=True):
        t = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0, 1)
        nearest = np.minimum(nearest, np.hypot(*(points - a - t[:, None] * (b - a)).T))
    return nearest


def score_map(field, padded_shape, ranges, bearings, heading, spacing, reach, rules):
    """Σ w L(x + p) over the points p of a scan, at all nodes x of `field`.

    Beyond the field lies emptiness up to `padded_shape`, and there the world comes
    round again. End points share their vote bilinearly among the four nodes around
    them; points inside the rays vote, negatively, for the nearest node.

    Args:
        field: (rows, columns) likelihood L at the nodes.
        padded_shape: rows and columns after which the correlation repeats itself.
        ranges, bearings: (n,) rays; non-finite ranges are echoless, seen to `reach`.
        heading: direction of bearing 0 in the lattice's frame [rad].
        spacing: distance between nodes [m].
        reach: longest range that votes [m].
        rules: `(through, through_weight, clear_of_wall)`: the shares of a ray at which
            it is probed, what all its probes weigh, and how far from the end point
            they must lie [m].
    """
    through, through_weight, clear_of_wall = rules
    padded = np.zeros(padded_shape)
    padded[: field.shape[0], : field.shape[1]] = field
    rows, columns = field.shape
    near = ranges < reach
    weight = np.sqrt(np.clip(np.where(np.isfinite(ranges), ranges, 1e9), 0.3, 10.0))
    weight = weight / weight[near].sum()
    score = np.zeros(field.shape)

    def vote(row, column, share):
        there = np.roll(padded, (-row, -column), axis=(0, 1))
        score[:] += share * there[:rows, :columns]

    for r, bearing, w in zip(ranges, bearings, weight, strict=True):
        d = np.array([np.cos(heading + bearing), np.sin(heading + bearing)])
        if r < reach:
            x, y = r * d / spacing
            i, j = int(np.floor(y)), int(np.floor(x))
            v, u = y - i, x - j
            vote(i, j, w * (1 - v) * (1 - u))
            vote(i, j + 1, w * (1 - v) * u)
            vote(i + 1, j, w * v * (1 - u))
            vote(i + 1, j + 1, w * v * u)
        seen = min(r, reach)
        for share in through:
            if (1 - share) * seen > clear_of_wall:
                x, y = np.rint(share * seen * d / spacing).astype(int)
                vote(y, x, -w * through_weight / len(through))
    return score


def best_of_blocks(scores, allowed):
    """Best score of each 6 headings × 2 rows × 2 columns of (headings, rows, columns)."""
    scores = np.where(allowed, scores, -np.inf)
    headings, rows, columns = scores.shape
    best = [
        scores[k : k + 6, i : i + 2, j : j + 2].max()
        for k in range(0, headings, 6)
        for i in range(0, rows, 2)
        for j in range(0, columns, 2)
    ]
    return np.sort(best)[::-1]


def range_jacobian(start, end, pose, bearings):
    """Derivatives (n, 4) of the ranges by [x, y, θ, wall thickness].

    By central differences of exact ray casts. A wall that is b thicker is met
    b / cos(incidence) earlier, and 1 / cos(incidence) is how far the range changes
    when the sensor moves straight at the wall: the length of ∂r/∂(x, y).
    """
    h, limit = 1e-6, 1e6

    def ranges(pose):
        return cast_walls(start, end, pose[:2], pose[2] + bearings, limit)

    J = np.stack(
        [(ranges(pose + h * e) - ranges(pose - h * e)) / (2 * h) for e in np.eye(3)],
        axis=1,
    )
    return np.column_stack([J, np.hypot(J[:, 0], J[:, 1])])
