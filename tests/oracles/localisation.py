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


def score_map(field, ranges, bearings, heading, spacing, reach, rules):
    """Σ w L(x + p) over the points p of a scan, at all nodes x of `field`.

    Beyond the field lies emptiness. End points share their vote bilinearly among the
    four nodes around them; points inside the rays vote, negatively, for the nearest
    node.

    Args:
        field: (rows, columns) likelihood L at the nodes.
        ranges, bearings: (n,) rays; non-finite ranges are echoless, seen to `reach`.
        heading: direction of bearing 0 in the lattice's frame [rad].
        spacing: distance between nodes [m].
        reach: longest range that votes [m].
        rules: `(through, through_weight, clear_of_wall)`: the shares of a ray at which
            it is probed, what all its probes weigh, and how far from the end point
            they must lie [m].
    """
    through, through_weight, clear_of_wall = rules
    rows, columns = field.shape
    rim = int(np.ceil(reach / spacing)) + 1
    around = np.pad(field, rim)
    near = ranges < reach
    weight = np.sqrt(np.clip(np.where(np.isfinite(ranges), ranges, 1e9), 0.3, 10.0))
    weight = weight / weight[near].sum()
    score = np.zeros(field.shape)

    def vote(row, column, share):
        i, j = rim + row, rim + column
        score[:] += share * around[i : i + rows, j : j + columns]

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


def best_of_boxes(scores, allowed, core, headings, nodes):
    """Best scores of boxes of poses, sorted, best first.

    Args:
        scores: (all headings, rows, columns).
        allowed: (rows, columns); boxes without any are left out.
        core: rows and columns of a tile, whose corner is that of its first box.
        headings: in a box.
        nodes: rows and columns in a box; those at a tile's end may have fewer.
    """
    starts = lambda side: [
        (tile + box, tile + min(box + nodes, core))
        for tile in range(0, side, core)
        for box in range(0, core, nodes)
    ]
    best = []
    for top, bottom in starts(allowed.shape[0]):
        for left, right in starts(allowed.shape[1]):
            some = allowed[top:bottom, left:right]
            if some.any():
                here = scores[:, top:bottom, left:right][:, some]
                best += list(here.reshape(-1, headings * some.sum()).max(axis=1))
    return np.sort(best)[::-1]


def shell_counts(ranges, counted, width, number):
    """Rays that end in each of so many shells of that width, one ray at a time."""
    count = np.zeros(number, int)
    for r, counts in zip(ranges, counted, strict=True):
        if counts and r < number * width:
            count[int(r // width)] += 1
    return count


def share_explained(scan, counted, place, shift, width):
    """Share of a scan's counted rays that end where a place's do, or a shell beside.

    Args:
        scan: (rays,) ranges [m], equiangular over the circle.
        counted: (rays,) which of them count.
        place: (rays,) ranges from the place [m].
        shift: by how many rays the sensor is turned.
        width: of a shell [m].
    """
    apart = np.abs(scan // width - np.roll(place, -shift) // width)
    return np.mean(apart[counted] <= 1)


def on_walls(distance, scan, pose, rules):
    """Weight of the echoes that end on walls, less that of ways along or through some.

    Args:
        distance: (n, 2) points to distances from the nearest wall [m].
        scan: the scan.
        pose: of the lidar [m, m, rad].
        rules: `(shares, near, clear_of_wall)`: where along a ray it is probed, the σ of
            "on a wall" [m], and how far from its end a probe must lie [m].
    """
    shares, near, clear_of_wall = rules
    on_wall = lambda point: np.exp(-0.5 * (distance(point[None])[0] / near) ** 2)
    rays = scan.ranges, scan.bearings, scan.valid, scan.echo
    gain = loss = weight = 0.0
    for r, b, valid, echo in zip(*(np.asarray(a).tolist() for a in rays), strict=True):
        heading = pose[2] + b
        say = np.clip(r, 0.3, 10.0) ** 0.25
        ray = r * np.array([np.cos(heading), np.sin(heading)])
        if echo:
            weight += say
            gain += say * on_wall(pose[:2] + ray)
        for share in shares:
            if valid and (1 - share) * r > clear_of_wall:
                loss += 0.5 * say / len(shares) * on_wall(pose[:2] + share * ray)
    return (gain - loss) / weight


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
