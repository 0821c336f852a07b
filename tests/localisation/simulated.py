"""What the tests of tracking share: a lidar, an office, and ways to measure an error."""

import jax
import jax.numpy as jnp
import numpy as np

from fsmsm_jax.localisation import tracker
from fsmsm_jax.sensing import Lidar, Scan
from fsmsm_jax.world import OccupancyGrid, buildings

NOISE = 0.01
LIDAR = Lidar.create(180, range_max=12.0, noise=NOISE)
ENDS = np.array([[35.0, 74.0], [298.0, 194.0]])
"""Of a way through `office(1)`, in cells."""


def office(seed: int = 1) -> OccupancyGrid:
    """11 m by 16 m, away from the origin and turned; of one shape for all seeds."""
    cells = np.asarray(buildings.office(seed=seed, width=15, height=10).cells)
    return OccupancyGrid.from_cells(cells, 0.05, (20.0, -30.0, 0.7))


def error(found, true):
    """Distances [m] and heading differences [rad]."""
    off = np.asarray(found, float) - np.asarray(true, float)
    turn = np.abs(np.mod(off[..., 2] + np.pi, 2 * np.pi) - np.pi)
    return np.hypot(off[..., 0], off[..., 1]), turn


def distance(found, true):
    """Of positions [m]."""
    return error(found, true)[0]


def nees(info, true):
    """The error squared, in the covariance's own measure: 3 on average if honest."""
    off = np.asarray(info.pose, float) - np.asarray(true, float)
    off[:, 2] = np.mod(off[:, 2] + np.pi, 2 * np.pi) - np.pi
    solved = np.linalg.solve(np.asarray(info.covariance, float), off[..., None])
    return np.sum(off * solved[..., 0], axis=1)


def part(tree, index):
    """One of what is stacked, or some."""
    return jax.tree.map(lambda a: a[index], tree)


def blind(scan):
    """No ray says anything."""
    none = jnp.zeros_like(scan.valid)
    full = jnp.full_like(scan.ranges, scan.range_max)
    bearings, most = jnp.asarray(scan.bearings), jnp.asarray(scan.range_max)
    return Scan(full, bearings, none, none, most)


def start(world, poses, odometry):
    """A tracker at the first of these."""
    return tracker.init(world, poses[0], None, odometry[0])
